"""Workers that do not answer: how long each has been silent since it was given a job, and when that
is too long.

Pure.

A worker that works on a chunk says nothing meanwhile, so that only time tells whether its task
hangs. How much time is usual follows from the rollouts so far: `Scheduler.patience` is four times
the usual wait for an answer.
"""

from dataclasses import dataclass
from typing import Final

LINE: Final = 10.0
"""Least silence after which a line says so [s]."""
END: Final = 30.0
"""Least silence after which a worker's process is ended [s]."""
_LINE, _END = 3.0, 6.0  # and so many times the scheduler's patience
# [s] before a worker's first answer: imports and compilers take their time
_FIRST_LINE, _FIRST_END = (60.0, 300.0)
_RARE: Final = 50  # rounds for each of which a task may hang once
_MOST: Final = 3  # workers that may be ended however few rounds there were


@dataclass
class Silence:
    """A worker that has jobs, and has not answered since."""

    since: float
    """When it was given the job, or has last answered [s]."""
    job: int
    """Of the round in which it was given the job."""
    generation: int
    said: bool = False
    """Whether a line has said so."""
    over: bool = False
    """Whether its process was ended."""


class Silences:
    """Every worker that has not answered; times are seconds of one monotonic clock."""

    def __init__(self) -> None:
        self._of: dict[str, Silence] = {}
        self._answered: set[str] = set()
        self.ended = 0
        """Number of workers whose processes were ended."""

    def given(self, worker: str, job: int, generation: int, now: float) -> None:
        """A worker was given a job; if it has others, it is silent since these."""
        self._of.setdefault(worker, Silence(now, job, generation))

    def heard(self, worker: str, now: float, *, waiting: bool) -> None:
        """A worker has sent a message; `waiting`: it still has jobs."""
        self._answered.add(worker)
        if (silence := self._of.get(worker)) is not None:
            silence.since, silence.said = now, False
            if not waiting:
                del self._of[worker]

    def left(self, worker: str) -> None:
        """A worker is gone."""
        self._of.pop(worker, None)
        self._answered.discard(worker)

    def long(self, now: float, patience: float) -> list[tuple[str, Silence, bool]]:
        """Workers whose silence has just become too long, and whether their process is to be
        ended.
        """
        found = []
        for worker, silence in self._of.items():
            first = worker not in self._answered
            line = max(LINE, _LINE * patience, _FIRST_LINE if first else 0.0)
            end = max(END, _END * patience, _FIRST_END if first else 0.0)
            over = now - silence.since >= end
            if not silence.over and (over or (not silence.said and now - silence.since >= line)):
                silence.said, silence.over = True, over
                found.append((worker, silence, over))
        return found

    def end(self, rounds: int) -> bool:
        """Note that a worker's process was ended; return whether that is so often that the task
        is to blame.
        """
        self.ended += 1
        return self.ended > _MOST and self.ended * _RARE > rounds
