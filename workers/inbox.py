"""What a worker holds of each run: the round's header and the chunks that wait.

Limited: learners may be hostile.
"""

import time
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from farm.errors import ConfigError, MessageError
from farm.net import keys
from farm.net.work import Chunk, RoundHeader

_RUNS: Final = 1000  # that are served at the same time
_HELD: Final = 1000  # chunks of one run; credits keep an honest learner far below it
# Jobs held per job requested, of one run: jobs may be sent twice, or while a request is on its way
_CREDITS: Final = 4
_EARLY: Final = 4  # chunks of one run that wait for their header
_MEMORY: Final = 256 << 20  # [bytes] of all runs' means and chunks that wait
_ON_ITS_WAY: Final = 0.1  # [s] for a header that was published before a chunk that is here


@dataclass
class RunInbox:
    """One run's messages."""

    header: RoundHeader | None = None
    chunks: deque[Chunk] = field(default_factory=deque)
    early: deque[tuple[float, Chunk]] = field(default_factory=deque)
    """Chunks that overtook their header, and when each came [s]; headers come by another thread."""
    busy: float = field(default_factory=time.monotonic)
    """When it last had work, or when its learner was last told that it has none [s]."""

    def holds_round_of(self, chunk: Chunk) -> bool:
        """Whether a chunk is of the round whose header is here."""
        header = self.header
        return header is not None and (chunk.incarnation, chunk.round) == (
            header.incarnation,
            header.round,
        )

    @property
    def nbytes(self) -> int:
        """Size of the messages [bytes]."""
        early = (chunk for _, chunk in self.early)
        return sum(map(_bytes, [*self.chunks, *early, *([self.header] if self.header else [])]))


class Inbox:
    """Messages of all runs, those of the run that has waited longest first."""

    def __init__(self, credits: int) -> None:
        """Set the number of jobs that learners are asked for."""
        self._credits = credits
        self._runs: OrderedDict[str, RunInbox] = OrderedDict()

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs."""
        return tuple(self._runs)

    @property
    def working(self) -> bool:
        """Whether a chunk waits."""
        return any(run.chunks for run in self._runs.values())

    def of(self, run: str) -> RunInbox:
        """A run's messages; begins without any.

        Raises:
          MessageError: the name is malformed, or there are too many runs.
        """
        try:
            keys.checked("run", run)
        except ConfigError as error:
            raise MessageError(str(error)) from None
        if run not in self._runs and len(self._runs) >= _RUNS:
            raise MessageError(f"run {run[:40]}: {_RUNS} runs are served already", "large")
        return self._runs.setdefault(run, RunInbox())

    def begin(self, header: RoundHeader, *, asked: bool = False) -> None:
        """Start a new round and drop work of older ones.

        A header that was asked for overrides published ones.
        """
        run = self.of(header.run)
        old = run.header
        if old and old.incarnation == header.incarnation:
            if header.round == old.round or (header.round < old.round and not asked):
                return
        self._make_room(header)
        run.header, run.busy = header, time.monotonic()
        run.chunks.clear()
        early = [(since, chunk) for since, chunk in run.early if chunk.round >= header.round]
        run.early.clear()
        for since, chunk in early:
            if run.holds_round_of(chunk):
                self.put(chunk)
            else:
                run.early.append((since, chunk))

    def keep_early(self, chunk: Chunk, now: float) -> bool:
        """Keep a chunk of the learner's next rounds until its header comes; false if that is not on
        its way, or if too many wait.

        Raises:
          MessageError: its run sends more than fits into memory.
        """
        run = self.of(chunk.run)
        header = run.header
        if (
            header is None
            or chunk.incarnation != header.incarnation
            or chunk.round <= header.round
            or len(run.early) >= _EARLY
        ):
            return False
        self._make_room(chunk)
        run.early.append((now, chunk))
        return True

    @property
    def expecting(self) -> bool:
        """Whether a chunk waits for its header."""
        return any(run.early for run in self._runs.values())

    def overdue(self, now: float) -> list[Chunk]:
        """Take out the chunks whose header has not come in time [s]."""
        chunks = []
        for run in self._runs.values():
            while run.early and now - run.early[0][0] >= _ON_ITS_WAY:
                chunks.append(run.early.popleft()[1])
        return chunks

    def put(self, chunk: Chunk) -> None:
        """Keep a chunk of a round that has begun.

        Raises:
          MessageError: its run sends more than was asked for, or more than fits into memory.
        """
        run = self.of(chunk.run)
        jobs = len(chunk) + sum(map(len, run.chunks))
        if jobs > _CREDITS * self._credits or len(run.chunks) >= _HELD:
            raise MessageError(
                f"run {chunk.run} sends {jobs} jobs, {self._credits} were asked for", "large"
            )
        self._make_room(chunk)
        run.chunks.append(chunk)

    def next(self) -> tuple[RoundHeader, Chunk] | None:
        """A chunk of the run that has waited longest, with its round."""
        for name, run in list(self._runs.items()):
            if run.chunks:
                assert run.header is not None
                self._runs.move_to_end(name)
                return run.header, run.chunks.popleft()
        return None

    def idle(self, now: float, seconds: float) -> tuple[str, ...]:
        """Runs that have had no chunk for this time.

        Each is returned again only after the same time.
        """
        names = [
            name for name, run in self._runs.items() if not run.chunks and now - run.busy >= seconds
        ]
        for name in names:
            self._runs[name].busy = now
        return tuple(names)

    def left(self, run: str) -> RoundHeader | None:
        """Drop a run whose learner left; returns its last header."""
        messages = self._runs.pop(run, None)
        return messages.header if messages else None

    def _make_room(self, message: RoundHeader | Chunk) -> None:
        """Make sure that a message fits into memory: drop other runs' messages, oldest first.

        They are requested again.

        Raises:
          MessageError: its own run alone holds too much.
        """
        sizes = {name: run.nbytes for name, run in self._runs.items()}
        total = sum(sizes.values()) + _bytes(message)
        for name, run in self._runs.items():
            if total > _MEMORY and name != message.run:
                total -= sizes[name]
                run.header = None
                run.chunks.clear()
                run.early.clear()
        if total > _MEMORY:
            raise MessageError(
                f"run {message.run} wants more than {_MEMORY >> 20} MiB kept", "large"
            )


def _bytes(message: RoundHeader | Chunk) -> int:
    return sum(getattr(value, "nbytes", 0) for value in vars(message).values())
