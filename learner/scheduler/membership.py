"""Which workers may join a run, which are connected, and their statistics. Pure: time is an argument [s]."""

from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus

_MOST: Final = 10_000  # tokens; more workers than one learner can serve
_MOST_OF_ONE: Final = 1000  # tokens per host name, so that one host cannot use up the limit for all
_ASKING: Final = 1000  # workers whose request arrived before their token
_SOON: Final = 3.0  # [s] within which the token must follow: token and request travel separately
_WINDOW: Final = 10.0  # [s] over which a worker's rate is measured


class Admission:
    """Admits or refuses workers by the properties in their requests for work."""

    def __init__(self, canary: str | None, *, mixed: bool = False) -> None:
        """Set the rules of a run.

        Args:
          canary: digest of how the run's machines round; None until the first result is accepted.
          mixed: also admit machines that round differently: the run is then not reproducible.
        """
        self.mixed, self.canary = mixed, canary

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may."""
        if not want.canary and not self.mixed:
            return (
                "it is a device, whose results cannot be repeated: start the learner with --mixed; "
                "the run is then not reproducible"
            )
        if self.canary in (None, want.canary) or self.mixed:
            return None
        return (
            "its machine rounds differently from those the run began with (another processor or library): "
            "use a machine like them, or start the learner with --mixed; the run is then not reproducible"
        )

    def counted(self, canary: str) -> bool:
        """Note an accepted result from a machine with this canary; return whether it was the first of the run."""
        if self.canary is not None or not canary:
            return False
        self.canary = canary
        return True


class Attendance:
    """Liveliness tokens of workers, and requests that arrived before their token."""

    def __init__(self) -> None:
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
            if len(self._there) >= _MOST or self._names[name] >= _MOST_OF_ONE:
                raise MessageError(f"there are already {_MOST} workers, or {_MOST_OF_ONE} of its name", "absent")
            self._there.add(worker)
            self._names[name] += 1
        return self._early.pop(worker, (None, 0.0))[0]

    def early(self, most: int) -> list[str]:
        """Some workers that asked but whose token has not come; those not returned for the longest time first."""
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
        """Return whether the worker that asks is connected; if not, keep its request until its token comes.

        Raises:
          MessageError: too many requests are kept already.
        """
        if want.worker in self._there:
            return True
        if want.worker not in self._early and len(self._early) >= _ASKING:
            raise MessageError(f"there are already {_ASKING} requests of workers without a token", "absent")
        self._early[want.worker] = want, self._early.get(want.worker, (want, now))[1]
        return False

    def absent(self, now: float) -> list[str]:
        """Forget requests whose token did not follow in time; return the workers' names."""
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
    """Workers by name, with their recent work."""

    def __init__(self) -> None:
        self._known: dict[str, _Known] = {}

    def asked(self, want: WorkRequest, now: float) -> None:
        """A worker asked for work."""
        known = self._known.setdefault(want.worker, _Known(want, now, now))
        known.want, known.seen = want, now

    def did(self, worker: str, rollouts: int, now: float) -> None:
        """A worker sent results."""
        known = self._known.get(worker)
        if known is not None:
            known.seen, known.rollouts = now, known.rollouts + rollouts
            known.recent.append((now, rollouts))
            while known.recent[0][0] < now - _WINDOW:
                known.recent.popleft()

    def canary(self, worker: str) -> str:
        """The digest of how a worker rounds; empty if it is a device or has left."""
        known = self._known.get(worker)
        return "" if known is None else known.want.canary

    def requests(self) -> list[WorkRequest]:
        """The last request of each worker."""
        return [known.want for known in self._known.values()]

    def left(self, worker: str) -> None:
        """A worker has left."""
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
    """Time over which a rate is measured: since the worker joined, but 1 s at least and the window at most."""
    return min(_WINDOW, max(1.0, seconds))
