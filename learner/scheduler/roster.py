"""The workers of one run: which take part, with their recent work, and why others do not. Pure: time is an argument."""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus
from learner.scheduler.audit import host
from learner.scheduler.membership import Admission

_REFUSED: Final = 10_000  # number of refused workers that are remembered
_WINDOW: Final = 10.0  # [s] over which a worker's rate is measured


@dataclass
class _Member:
    want: WorkRequest
    since: float
    seen: float
    rollouts: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=deque)


class Roster:
    """Members by name; refused, declined and expelled workers with the reasons."""

    def __init__(self, admission: Admission) -> None:
        self._admission = admission
        self._members: dict[str, _Member] = {}
        self.refused: dict[str, str] = {}
        """Workers that this run does not take, and why."""
        self.declined: dict[str, str] = {}
        """Workers that cannot serve this run, and why."""

    @property
    def reasons(self) -> list[str]:
        """Why workers do not take part."""
        return [*self.refused.values(), *self.declined.values()]

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may."""
        return self._admission.refusal(want)

    def asked(self, want: WorkRequest, now: float) -> None:
        """A worker that may take part asked for work."""
        self.refused.pop(want.worker, None)
        member = self._members.setdefault(want.worker, _Member(want, now, now))
        member.want, member.seen = want, now

    def did(self, worker: str, rollouts: int, now: float) -> None:
        """A worker sent results."""
        member = self._members.get(worker)
        if member is not None:
            member.seen, member.rollouts = now, member.rollouts + rollouts
            member.recent.append((now, rollouts))
            while member.recent[0][0] < now - _WINDOW:
                member.recent.popleft()

    def refuse(self, worker: str, reason: str) -> None:
        """Remember why a worker is not taken; it no longer takes part."""
        self._members.pop(worker, None)
        if len(self.refused) < _REFUSED:
            self.refused[worker] = reason

    def decline(self, worker: str, reason: str) -> None:
        """Remember why a worker cannot serve the run; it no longer takes part."""
        self._members.pop(worker, None)
        self.declined[worker] = reason

    def left(self, worker: str) -> None:
        """A worker is gone, and may come back as another."""
        for table in (self._members, self.refused, self.declined):
            table.pop(worker, None)

    def canary(self, worker: str) -> str:
        """The digest of how a worker rounds; empty if it is a device or does not take part."""
        member = self._members.get(worker)
        return "" if member is None else member.want.canary

    def expel(self, name: str, reason: str) -> list[str]:
        """Take no worker of a host any more; return those that take part."""
        self._admission.expelled[name] = reason
        return [worker for worker in self._members if host(worker) == name]

    def status(self, now: float) -> tuple[WorkerStatus, ...]:
        """The members, by name."""
        return tuple(
            WorkerStatus(
                worker=name,
                host=member.want.host,
                cores=member.want.cores,
                version=member.want.version,
                canary=member.want.canary,
                rollouts=member.rollouts,
                rate=sum(count for at, count in member.recent if at >= now - _WINDOW) / _over(now - member.since),
                seen=now - member.seen,
                ignored=member.want.ignored,
            )
            for name, member in sorted(self._members.items())
        )


def _over(seconds: float) -> float:
    """Time over which a rate is measured: since the worker joined, but 1 s at least and the window at most."""
    return min(_WINDOW, max(1.0, seconds))
