"""The recorder behind a thread: learning never waits for it, nor falls with it."""

import contextlib
import logging
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol

from farm.arrays import AnyArray
from farm.net.stats import Progress
from farm.sim.trajectory import Trajectory

log = logging.getLogger(__name__)

WAITING: Final = 256
"""Messages that may wait before rollouts and traces are dropped."""

QUIET: Final = 0.5
"""When nothing has come for so long, what the recorder holds back is written [s]."""


class Recording(Protocol):
    """What `Recorder` offers."""

    @property
    def uri(self) -> str | None:
        """What a viewer opens to look on."""
        ...

    def generation(
        self,
        progress: Progress,
        sample: Trajectory | None,
        traces: Mapping[str, AnyArray],
        rate: float,
    ) -> None:
        """Record a generation."""
        ...

    def log(self, text: str, level: str = "INFO") -> None:
        """Record a line."""
        ...

    def result(self, values: Mapping[str, object]) -> None:
        """Record what came out."""
        ...

    def replay(self, path: Path, rollouts: Sequence[tuple[str, Trajectory]]) -> None:
        """Record rollouts into a file of their own."""
        ...

    def settle(self) -> None:
        """Write what is held back."""
        ...

    def close(self, *, merge: bool = True) -> None:
        """End the recording."""
        ...


class RecorderThread:
    """Hands everything on to a recorder, in a thread of its own.

    When more than `waiting` messages wait, rollouts and traces are dropped, and counted; statistics
    and lines never. A recorder that fails (a full disk) ends the recording with one line in the log.
    """

    def __init__(self, recorder: Recording, waiting: int = WAITING) -> None:
        self._recorder, self._waiting = recorder, waiting
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._failed = threading.Event()
        self._dropped = 0
        self._merge = True
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def uri(self) -> str | None:
        """What a viewer opens to look on."""
        return self._recorder.uri

    @property
    def dropped(self) -> int:
        """Generations recorded without their rollout and traces, because too many waited."""
        return self._dropped

    @property
    def failed(self) -> bool:
        """Whether the recording ended before its time."""
        return self._failed.is_set()

    def generation(
        self,
        progress: Progress,
        sample: Trajectory | None,
        traces: Mapping[str, AnyArray],
        rate: float,
    ) -> None:
        """Have a generation recorded; see `Recorder.generation`."""
        if self._queue.qsize() >= self._waiting and (sample is not None or traces):
            sample, traces = None, {}
            self._dropped += 1
        self._put(lambda: self._recorder.generation(progress, sample, traces, rate))

    def log(self, text: str, level: str = "INFO") -> None:
        """Have a line recorded."""
        self._put(lambda: self._recorder.log(text, level))

    def result(self, values: Mapping[str, object]) -> None:
        """Have it recorded what came out."""
        self._put(lambda: self._recorder.result(values))

    def replay(self, path: Path, rollouts: Sequence[tuple[str, Trajectory]]) -> None:
        """Have rollouts recorded into a file of their own."""
        self._put(lambda: self._recorder.replay(path, rollouts))

    def settled(self) -> bool:
        """Wait until what was handed over is recorded; false when the recording ended before its time."""
        reached = threading.Event()
        self._put(self._recorder.settle)
        self._put(reached.set)
        while not (reached.wait(0.1) or self.failed):
            pass
        return not self.failed

    def close(self, timeout: float | None = None, *, merge: bool = True) -> bool:
        """Record what waits and end the recording.

        Args:
          timeout: how long that may take [s]; None for as long as it takes.
          merge: whether to compact the file as well.

        Returns:
          whether everything is recorded.
        """
        self._merge = merge
        self._queue.put(None)
        self._thread.join(timeout)
        if self._thread.is_alive():
            log.warning("the recording is not complete after %g s: left as it is", timeout)
            return False
        return not self.failed

    def _put(self, call: Callable[[], None]) -> None:
        if not self.failed:
            self._queue.put(call)

    def _work(self) -> None:
        try:
            while (call := self._next()) is not None:
                call()
            self._recorder.close(merge=self._merge)
        except Exception as error:
            self._failed.set()
            log.error("the recording ends here, learning goes on: %s", error)
            self._abandon()

    def _next(self) -> Callable[[], None] | None:
        """What to do next; where nothing comes for a while, to write what is held back."""
        try:
            return self._queue.get(timeout=QUIET)
        except queue.Empty:
            return self._recorder.settle

    def _abandon(self) -> None:
        """Let go of what waits, and keep what is recorded as far as that goes."""
        while not self._queue.empty():
            self._queue.get()
        with contextlib.suppress(Exception):
            self._recorder.close(merge=self._merge)
