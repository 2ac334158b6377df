"""Which workers may join a run, which are connected, and what is known of each. Pure: time is an argument [s]."""

from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus

_MOST: Final = 10_000  # tokens; more workers than a learner feeds
_MOST_OF_ONE: Final = 1000  # tokens of one name: nobody keeps others out by showing many of its own
_ASKING: Final = 1000  # that ask before their token came
_SOON: Final = 3.0  # [s] within which it does: token and request take different ways
_WINDOW: Final = 10.0  # [s] over which a worker's rate is taken


class Admission:
    """Judges workers by what they say of themselves when they ask for work."""

    def __init__(self, canary: str | None, *, mixed: bool = False) -> None:
        """Know the run.

        Args:
          canary: digest of the numbers that the run's machines give; None until the first result counts.
          mixed: admit machines whose numbers differ: the run is then not reproducible.
        """
        self.mixed, self.canary = mixed, canary

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may."""
        if not want.canary and not self.mixed:
            return (
                "it is a device, whose numbers are not to be had again: start the learner with --mixed and do without "
                "repeatable numbers"
            )
        if self.canary in (None, want.canary) or self.mixed:
            return None
        return (
            "its machine rounds differently from those the run began with (another processor or library): "
            "take a machine like them, or start the learner with --mixed and do without repeatable numbers"
        )

    def counted(self, canary: str) -> bool:
        """A result of such a machine counted; say whether it was the first, which decides whose numbers the run has."""
        if self.canary is not None or not canary:
            return False
        self.canary = canary
        return True


class Attendance:
    """Tokens, and questions that came ahead of theirs."""

    def __init__(self) -> None:
        self._there: set[str] = set()
        self._names: Counter[str] = Counter()
        self._early: dict[str, tuple[WorkRequest, float]] = {}

    def came(self, worker: str) -> WorkRequest | None:
        """A token appeared; return what its worker asked for before.

        Raises:
          MessageError: there are too many.
        """
        if worker not in self._there:
            name = worker.partition("/")[0]
            if len(self._there) >= _MOST or self._names[name] >= _MOST_OF_ONE:
                raise MessageError(f"{_MOST} workers, or {_MOST_OF_ONE} of its name, are there already", "absent")
            self._there.add(worker)
            self._names[name] += 1
        return self._early.pop(worker, (None, 0.0))[0]

    def early(self, most: int) -> list[str]:
        """Some that have asked and whose token has not come, those of whom that was said longest ago first."""
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
        """Say whether the worker that asks is connected; another's request is kept for a while, until it is.

        Raises:
          MessageError: too many requests are kept already.
        """
        if want.worker in self._there:
            return True
        if want.worker not in self._early and len(self._early) >= _ASKING:
            raise MessageError(f"{_ASKING} others ask whose tokens are not there", "absent")
        self._early[want.worker] = want, self._early.get(want.worker, (want, now))[1]
        return False

    def absent(self, now: float) -> list[str]:
        """Forget who asked and never came; their names."""
        gone = [worker for worker, (_, since) in self._early.items() if now - since > _SOON]
        for worker in gone:
            del self._early[worker]
        return gone


@dataclass
class _Known:
    want: WorkRequest
    since: float
    seen: float
    rollouts: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=deque)


class Census:
    """Workers by name, with what they did lately."""

    def __init__(self) -> None:
        self._known: dict[str, _Known] = {}

    def asked(self, want: WorkRequest, now: float) -> None:
        """A worker asked for work."""
        known = self._known.setdefault(want.worker, _Known(want, now, now))
        known.want, known.seen = want, now

    def did(self, worker: str, rollouts: int, now: float) -> None:
        """A worker brought results."""
        known = self._known.get(worker)
        if known is not None:
            known.seen, known.rollouts = now, known.rollouts + rollouts
            known.recent.append((now, rollouts))
            while known.recent[0][0] < now - _WINDOW:
                known.recent.popleft()

    def canary(self, worker: str) -> str:
        """The digest of a worker's numbers; empty where it is a device, or gone."""
        known = self._known.get(worker)
        return "" if known is None else known.want.canary

    def requests(self) -> list[WorkRequest]:
        """What each worker asked for last."""
        return [known.want for known in self._known.values()]

    def left(self, worker: str) -> None:
        """A worker is gone."""
        self._known.pop(worker, None)

    def status(self, now: float) -> tuple[WorkerStatus, ...]:
        """The connected workers, by name."""
        return tuple(
            WorkerStatus(
                worker=name,
                host=known.want.host,
                cores=known.want.cores,
                version=known.want.version,
                canary=known.want.canary,
                rollouts=known.rollouts,
                rate=sum(count for at, count in known.recent if at >= now - _WINDOW) / _over(now - known.since),
                seen=now - known.seen,
                ignored=known.want.ignored,
            )
            for name, known in sorted(self._known.items())
        )


def _over(seconds: float) -> float:
    """The time that a rate is taken over: the window, or as long as a worker has been here; a second at least."""
    return min(_WINDOW, max(1.0, seconds))
