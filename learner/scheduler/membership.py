"""Which workers may join a run, which are connected, and what is known of each. Pure: time is an argument [s]."""

from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus

_MOST: Final = 10_000  # tokens; more workers than a learner feeds
_ASKING: Final = 1000  # that ask before their token came
_SOON: Final = 3.0  # [s] within which it does: token and request take different ways
_WINDOW: Final = 10.0  # [s] over which a worker's rate is taken


class Admission:
    """Judges workers by what they say of themselves when they ask for work."""

    def __init__(self, canary: str | None, *, mixed: bool = False) -> None:
        """Know the run.

        Args:
          canary: digest of the numbers that the run's machines give; None until the first worker says it.
          mixed: admit machines whose numbers differ: the run is then not reproducible.
        """
        self._mixed, self._settled = mixed, canary is not None
        self.canary = canary
        """The digest that the run's numbers belong to, None as long as nobody has worked."""

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may; the first one decides whose numbers count."""
        if self.canary is None:
            self.canary = want.canary
        if want.canary != self.canary and not self._mixed:
            return (
                "its machine rounds differently from those the run began with (another processor or library): "
                "take a machine like them, or start the learner with --mixed and do without repeatable numbers"
            )
        return None

    def counted(self) -> None:
        """A result counted: the run has its numbers for good."""
        self._settled = True

    def deserted(self) -> None:
        """Nobody is left; as long as no result counted, whoever comes next decides."""
        if not self._settled:
            self.canary = None


class Attendance:
    """Tokens, and questions that came ahead of theirs."""

    def __init__(self) -> None:
        self._there: set[str] = set()
        self._early: dict[str, tuple[WorkRequest, float]] = {}

    def came(self, worker: str) -> WorkRequest | None:
        """A token appeared; return what its worker asked for before.

        Raises:
          MessageError: there are too many.
        """
        if worker not in self._there and len(self._there) >= _MOST:
            raise MessageError(f"{_MOST} workers are there already", "absent")
        self._there.add(worker)
        return self._early.pop(worker, (None, 0.0))[0]

    def early(self, most: int) -> list[str]:
        """Some that have asked and whose token has not come, those of whom that was said longest ago first."""
        names = list(islice(self._early, most))
        for name in names:
            self._early[name] = self._early.pop(name)
        return names

    def left(self, worker: str) -> None:
        """A token is gone."""
        self._there.discard(worker)
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
