"""Which workers may join a run, which are connected, and which take part.

Pure: time is an argument [s].
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus
from learner.scheduler.audit import host

_MOST: Final = 10_000  # tokens; more workers than one learner can serve
_ASKING: Final = 1000  # workers whose request arrived before their token
_SHOWN: Final = 8  # characters of a canary, as `farm status` shows them
_SOON: Final = 3.0  # [s] within which the token must follow: token and request travel separately
_REFUSED: Final = 10_000  # number of refused workers that are remembered
_WINDOW: Final = 10.0  # [s] over which a worker's rate is measured

NOBODY: Final[Mapping[str, str]] = {}
"""No expelled hosts."""


class Admission:
    """Admits or refuses workers by the properties in their requests for work."""

    def __init__(
        self, canary: str, expelled: Mapping[str, str] = NOBODY, *, mixed: bool = False
    ) -> None:
        """Set the rules of a run.

        Args:
          canary: digest of how the run's machines round, or how it begins. The learner's side says
            it, and no worker: the first to answer could shut out all others.
          expelled: hosts that have returned wrong numbers to this run, and the reasons.
          mixed: also admit machines that round differently: the run is then not reproducible.
        """
        self.mixed, self.canary = mixed, canary
        self.expelled: dict[str, str] = dict(expelled)
        """Hosts with wrong numbers, and why."""

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may."""
        if reason := self.expelled.get(host(want.worker)):
            return reason
        if not want.canary and not self.mixed:
            return (
                "it is a device, whose results cannot be repeated: start the learner with --mixed; "
                "the run is then not reproducible"
            )
        if want.canary.startswith(self.canary) or self.mixed:
            return None
        return (
            f"its machine rounds differently (numbers {want.canary[:_SHOWN]}, the run's are"
            f" {self.canary[:_SHOWN]}: another processor or library): use a machine like the"
            f" learner's, begin a run with --numbers {want.canary[:_SHOWN]} for machines like this"
            " one, or start the learner with --mixed; the run is then not reproducible"
        )


class Attendance:
    """Liveliness tokens of workers, and requests that arrived before their token."""

    def __init__(self, most: int = 500) -> None:
        """With at most this number of tokens per host name, so that one host cannot use up the
        limit for all.
        """
        self._most = most
        self._there: set[str] = set()
        self._names: Counter[str] = Counter()
        self._early: dict[str, tuple[WorkRequest, float]] = {}

    def came(self, worker: str) -> WorkRequest | None:
        """A token appeared; return the request that its worker sent before, if any.

        Raises:
          MessageError: there are too many tokens.
        """
        if worker not in self._there:
            name = worker.partition("/")[0]
            if len(self._there) >= _MOST or self._names[name] >= self._most:
                raise MessageError(
                    f"there are already {_MOST} workers, or {self._most} of its name", "absent"
                )
            self._there.add(worker)
            self._names[name] += 1
        return self._early.pop(worker, (None, 0.0))[0]

    def early(self, most: int) -> list[str]:
        """Some workers that asked but whose token has not come.

        Those not returned for the longest time first.
        """
        names = list(islice(self._early, most))
        for name in names:
            self._early[name] = self._early.pop(name)
        return names

    def left(self, worker: str) -> None:
        """A token is gone."""
        if worker in self._there:
            self._there.remove(worker)
            self._names[worker.partition("/")[0]] -= 1
        self._early.pop(worker, None)

    def asked(self, want: WorkRequest, now: float) -> bool:
        """Return whether the worker that asks is connected.

        If not, keep its request until its token comes.

        Raises:
          MessageError: too many requests are kept already.
        """
        if want.worker in self._there:
            return True
        if want.worker not in self._early and len(self._early) >= _ASKING:
            raise MessageError(
                f"there are already {_ASKING} requests of workers without a token", "absent"
            )
        self._early[want.worker] = want, self._early.get(want.worker, (want, now))[1]
        return False

    def absent(self, now: float) -> list[str]:
        """Forget requests whose token did not follow in time; return the workers' names."""
        workers = [worker for worker, (_, since) in self._early.items() if now - since > _SOON]
        for worker in workers:
            del self._early[worker]
        return workers


@dataclass
class _Member:
    want: WorkRequest
    since: float
    seen: float
    rollouts: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=deque)


class Members:
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
                rate=sum(count for at, count in member.recent if at >= now - _WINDOW)
                / _over(now - member.since),
                seen=now - member.seen,
                ignored=member.want.ignored,
            )
            for name, member in sorted(self._members.items())
        )


def _over(seconds: float) -> float:
    """Time over which a rate is measured: since the worker joined, but 1 s at least and the window
    at most.
    """
    return min(_WINDOW, max(1.0, seconds))
