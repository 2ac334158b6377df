"""Opens Rerun recordings and writes rows to them: several at once, on our own timelines."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun import bindings

from farm.arrays import FloatArray, IntArray
from learner.recording.curves import Columns
from learner.recording.files import next_part

FLUSH: Final = 30.0
"""How long rows may take to reach the file before the recording counts as broken [s]."""
APPLICATION: Final = "rolloutfarm"
_MARKDOWN: Final = "text/markdown"


@contextmanager
def recording(
    name: str, sinks: list[Any], layout: rrb.Blueprint, application: str = APPLICATION
) -> Iterator[rr.RecordingStream]:
    """A recording from `begin`, which is ended however the block ends.

    Raises:
      OSError: the files cannot be written.
    """
    stream = begin(name, sinks, layout, application)
    try:
        yield stream
    except BaseException:
        with suppress(OSError):  # the first reason counts
            end(stream)
        raise
    end(stream)


def begin(
    name: str, sinks: list[Any], layout: rrb.Blueprint, application: str = APPLICATION
) -> rr.RecordingStream:
    """Open a recording with that id for these sinks, layout first.

    The viewer keeps one layout per application.
    """
    rr.set_strict_mode(True)  # otherwise a wrong argument loses its column with a mere warning
    stream = rr.RecordingStream(application, recording_id=name)
    try:
        stream.set_sinks(*sinks)
        send_layout(stream, layout)
        stream.send_recording_name(name)
    except BaseException:
        with suppress(OSError):
            end(stream)
        raise
    return stream


def end(stream: rr.RecordingStream) -> None:
    """Write every row, and close: none of the recording's threads, files and memory is left.

    Raises:
      OSError: the files cannot be written.
    """
    if isinstance(stream.inner, _Released):
        return
    flush(stream)
    stream.disconnect()
    stream.inner = _Released()  # type: ignore[assignment]
    release()


def release() -> None:
    """Free the native part of recordings that nothing refers to: Rerun itself keeps them until the
    program ends.
    """
    with suppress(RuntimeError):  # of one that cannot be written: its own `flush` has said so
        bindings.flush_and_cleanup_orphaned_recordings()


def send_layout(stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
    """Send a layout to the viewers of a recording."""
    blueprint = _SentLayout(layout)
    stream.send_blueprint(blueprint)  # type: ignore[arg-type]
    blueprint.close()


class _SentLayout:
    """A layout whose stream can be closed: Rerun's copy of it in memory would keep itself and its
    threads alive.
    """

    def __init__(self, layout: rrb.Blueprint) -> None:
        self._layout = layout
        self._streams: list[rr.RecordingStream] = []

    def to_blueprint(self) -> "_SentLayout":
        """Return itself; called by Rerun."""
        return self

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        """Write the layout; called by Rerun."""
        self._streams.append(stream)
        self._layout._log_to_stream(stream)

    def close(self) -> None:
        """Close the stream that Rerun opened for it."""
        while self._streams:
            self._streams.pop().disconnect()


def file_sink(path: Path) -> rr.FileSink:
    """Open a recording's next file; an OSError if it cannot be written."""
    part = next_part(path)
    part.touch()  # fails with an errno; Rerun's own error has none
    return rr.FileSink(part)


def flush(stream: rr.RecordingStream) -> None:
    """Wait until every row is in the files.

    Raises:
      OSError: the files cannot be written; the stream writes nothing more.
    """
    try:
        stream.flush(timeout_sec=FLUSH)
    except RuntimeError as error:
        # Rerun would wait for this file forever, at the latest when the process ends.
        rr.unregister_shutdown()
        _BROKEN.append(stream.inner)
        stream.inner = _Released()  # type: ignore[assignment]
        raise OSError(f"Rerun has stopped writing ({error}): is the disk full?") from error


_BROKEN: Final[list[object]] = []
"""Native recordings that cannot be written.

Rerun waits for those that nothing refers to, whenever another one ends.
"""


class _Released:
    """Replaces a native recording that is closed, or must not be waited for."""

    def is_forked_child(self) -> bool:
        """Return true: Rerun releases those without waiting."""
        return True


def send_properties(stream: rr.RecordingStream, name: str, values: Mapping[str, object]) -> None:
    """Send properties that a table of recordings shows; later values replace earlier ones."""
    present: dict[str, Any] = {key: value for key, value in values.items() if value is not None}
    if present:
        stream.send_property(name, rr.AnyValues(**present))


def log_static(stream: rr.RecordingStream, entities: Iterable[tuple[str, Any]]) -> None:
    """Log static entities."""
    for entity, archetype in entities:
        stream.log(entity, archetype, static=True)


def markdown(text: str) -> rr.TextDocument:
    """A text with headings, tables and code."""
    return rr.TextDocument(text, media_type=_MARKDOWN)


def markdowns(texts: Sequence[str]) -> rr.ComponentColumnList:
    """Texts with headings, tables and code as columns, a row each."""
    return rr.TextDocument.columns(text=texts, media_type=[_MARKDOWN] * len(texts))


def row(archetype: Any) -> list[Any]:  # noqa: ANN401  (archetypes have no public base)
    """An archetype as columns of one row."""
    batches = archetype.as_component_batches()
    return [batch.partition([len(batch.as_arrow_array())]) for batch in batches]


def times(
    counter: str, numbers: IntArray, sim: FloatArray, wall: FloatArray | None = None
) -> list[rr.TimeColumn]:
    """Timelines of n rows: numbers (n,), times in the simulation and since the epoch (n,) [s]."""
    columns = [
        rr.TimeColumn(counter, sequence=numbers),
        rr.TimeColumn("sim_time", duration=_nanoseconds(sim).astype("timedelta64[ns]")),
    ]
    if wall is not None:
        columns.append(
            rr.TimeColumn("wall_time", timestamp=_nanoseconds(wall).astype("datetime64[ns]"))
        )
    return columns


def _nanoseconds(seconds: FloatArray) -> IntArray:
    """Rounded: Rerun would cut off."""
    return np.rint(seconds * 1e9).astype(np.int64)


def send(
    stream: rr.RecordingStream,
    columns: Iterable[Columns],
    counter: str,
    numbers: IntArray,
    sim: FloatArray,
    wall: FloatArray | None = None,
) -> None:
    """Send entities' rows; timelines are those of `times`, of all their frames."""
    whole = times(counter, numbers, sim, wall)
    for part in columns:
        at, rows = whole, part.rows
        if rows is not None:
            at = times(counter, numbers[rows], sim[rows], None if wall is None else wall[rows])
        stream.send_columns(part.entity, at, part.columns)


def send_gaps(stream: rr.RecordingStream, gaps: Iterable[Columns], sim: FloatArray) -> None:
    """Break curves at these times in the simulation (n,) [s].

    The other timelines have no time between rollouts.
    """
    for part in gaps:
        stream.send_columns(
            part.entity, times("", np.zeros(len(sim), dtype=int), sim)[1:], part.columns
        )
