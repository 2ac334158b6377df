"""What is known of the workers, for people who ask. Pure: time is an argument, in seconds."""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from farm.net.messages import Want
from farm.net.telemetry import WorkerStatus

_WINDOW: Final = 10.0  # [s] over which a worker's rate is taken


@dataclass
class _Known:
    want: Want
    since: float
    seen: float
    rollouts: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=deque)


class Census:
    """Workers by name, with what they did lately."""

    def __init__(self) -> None:
        self._known: dict[str, _Known] = {}

    def asked(self, want: Want, now: float) -> None:
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
        """Everybody who is here, by name."""
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
