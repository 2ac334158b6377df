"""A run as a Rerun recording: into a file, and live to viewers.

One recording per run, with the run's name as its id. Every row is on three timelines:

    generation   updates done, a sequence
    sim_time     generation x length of a rollout + time in that rollout, a duration without gaps
    wall_time    when it was recorded; a rollout's frames fill the time since the last one

A mean policy, including its rollout, is at the number of updates before it, 0 for the first:
generation G explores around the mean after G - 1 updates. A finished run's last policy is at its
last generation.

A file is never overwritten: a run that continues writes run.part2.rrd, and closing merges the parts
into run.rrd and compacts it. All parts opened together are one recording as well.
"""

import errno
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report
from farm.sim.trajectory import Trajectory, joined
from learner.recording import blueprint, curves
from learner.recording.channels import axes, pictures
from learner.recording.curves import Columns
from learner.recording.drawing import Drawing
from learner.recording.eye import Eye
from learner.recording.files import compact, with_layout
from learner.recording.replay import record_replay
from learner.recording.rows import (
    APPLICATION,
    begin,
    end,
    file_sink,
    flush,
    log_static,
    markdown,
    markdowns,
    release,
    row,
    send,
    send_gaps,
    send_layout,
    send_properties,
    times,
)
from learner.recording.stream import stream_port

log = logging.getLogger(__name__)

HOLD: Final = 0.5
"""Generations of this duration are written together: writing a row costs much more than its data
[s].
"""
SHARE: Final = 0.01
"""And those of this share of the time since the recording began, without viewers: until a file ends
Rerun keeps an entry in memory for each group of rows. So there are as many groups as the logarithm
of the time, unless HELD is reached first.
"""
HELD: Final = 8 << 20
"""Size of the reports at which they are written in any case [bytes]."""
RESERVE: Final = 32 << 20
"""Free disk space below which a recording ends [bytes]."""
SEAM: Final = 1e-6
"""Time from a rollout's last frame to the next one's first, which would hide it otherwise [s]."""
_LEVELS: Final = {"WARNING": "WARN"}  # the standard library's name in Rerun's


class Recorder:
    """Records a run, generation by generation. Thread: recorder, once a RunRecording has it."""

    def __init__(
        self,
        path: Path | None,
        *,
        run: str,
        drawing: Drawing,
        config: str,
        serve: tuple[str, int] | None = None,
        done: int = 0,
        ended: bool = False,
        properties: Mapping[str, object] | None = None,
        again: Callable[[GenerationStats], str] | None = None,
    ) -> None:
        """Open the file, or its next part if it exists, and the server.

        Args:
          path: of the recording.
          run: its name.
          drawing: the scene and its channels.
          config: the resolved configuration, Markdown.
          serve: host and port (0: any) for viewers; Rerun knows no passwords, so 127.0.0.1.
          done: generations that were recorded before.
          ended: whether the run has ended then, so that its policy's rollout is in the place of the
            next generation's.
          properties: values that identify the run.
          again: how to show a generation again, Markdown.

        Raises:
          ConfigError: neither path nor address, or the address is in use.
          OSError: the file cannot be written.
        """
        if path is None and serve is None:
            raise ConfigError(
                "a recording without a file and without an address to serve; give one"
            )
        spec, scene = drawing.spec, drawing.scene
        self._path, self._horizon, self._generation = path, spec.steps * spec.period, done
        self._last = time.time() - self._horizon
        # Reports that are held back, with when they came [s since the epoch]
        self._reports: list[tuple[float, Report]] = []
        self._held: list[_Held] = []  # and their rollouts
        self._size = 0  # of these reports [bytes]
        self._began = time.monotonic()
        self._since = self._began  # when the first of them came
        self._share = 0.0 if serve is not None else SHARE
        self._taken = done if ended else None  # place of a rollout
        self._broken = False
        self._finished: rrb.Blueprint | None = None
        self._drawing, self._again = drawing, again
        self.replay = partial(record_replay, run=run, drawing=drawing, config=config)
        """Records named rollouts into a file of their own."""
        if scene.left_out:
            log.info(
                "%d height fields or distance fields of the scene are not drawn", scene.left_out
            )
        self.uri: str | None = None
        """Address for viewers: `rerun URI`; None without a server."""
        sinks: list[Any] = []
        if serve is not None:
            host, port = serve[0], stream_port(*serve)
            self.uri = f"rerun+http://{f'[{host}]' if ':' in host else host}:{port}/proxy"
            sinks.append(rr.GrpcServerSink(host, port))
        if path is not None:
            sinks.append(file_sink(path))
        self._eye = Eye.of(drawing.view())
        self._stream = begin(run, sinks, blueprint.learning(drawing, self._eye))
        try:
            self._send_static(markdown(config), properties or {})
        except BaseException:
            with suppress(OSError):
                end(self._stream)
            raise

    def _send_static(self, config: rr.TextDocument, properties: Mapping[str, object]) -> None:
        spec = self._drawing.spec
        send_properties(self._stream, "run", properties)
        static = [
            *self._drawing.static(),
            *curves.static(success=spec.success, measures=spec.measures),
            ("/config", config),
        ]
        if spec.trace_channels:
            static += [
                each for entity in ("/traces/best", "/traces/worst") for each in axes(entity, spec)
            ]
        log_static(self._stream, static)

    def generation(self, report: Report) -> None:
        """Record a finished generation; it may be held back until `tend`, `settle` or `close`.

        The traces `best` and `worst` (T, K) are drawn as pictures; `all` (S, T, K) is kept bit by
        bit. K are the channels' values side by side, see `farm.sim.channels.flat`.

        Raises:
          ValueError: the sample or a trace has another shape.
          OSError: the file cannot be written (a full disk); what it has stays.
        """
        self._check_space()
        if report.sample is not None:
            self._drawing.check(report.sample)
        for name, values in report.traces.items():
            if values.shape[-2:] != self._drawing.spec.trace_shape:
                expected = self._drawing.spec.trace_shape
                raise ValueError(
                    f"trace {name} of shape {values.shape}, expected {expected} for each rollout"
                )
        self._generation, now = report.generation, time.time()
        if not self._reports:
            self._since = time.monotonic()
        self._reports.append((now, report))
        self._size += report.nbytes
        if report.sample is not None and report.generation - 1 != self._taken:
            self._hold(report.sample, report.generation - 1, now)
        self._last = now
        self.tend()

    def tend(self) -> None:
        """Write what is held back if it is time: after HOLD, or SHARE of the recording's time if
        that is longer, or once it has HELD bytes.

        Raises:
          OSError: the file takes no more.
        """
        now = time.monotonic()
        hold = max(HOLD, self._share * (now - self._began))
        if self._reports and (now - self._since >= hold or self._size >= HELD):
            self.settle()

    def settle(self) -> None:
        """Write what is held back.

        Raises:
          OSError: the file takes no more.
        """
        if self._reports or self._held:
            self._draw()
            self._flush()

    def final(self, rollout: Trajectory, generation: int) -> None:
        """Record the finished run's policy, the mean after a generation; viewers open with the end
        of its rollout.

        Raises:
          ValueError: it is a rollout of another scene or task.
          OSError: the file takes no more.
        """
        self._drawing.check(rollout)
        now = time.time()
        if generation == self._generation:  # the curves have earlier ones
            for part in curves.last_policy(rollout.returned, rollout.success):
                self._stream.send_columns(part.entity, self._at(now), part.columns)
        self._hold(rollout, self._generation, now, generation)
        # What is followed was recorded by the view of the start; that of this rollout knows how far
        # away to be.
        subject = Eye.of(self._drawing.view([rollout]))
        eye = replace(self._eye, away=subject.away) if subject.tracked else subject
        self._finished = blueprint.finished(self._drawing, eye)
        send_layout(self._stream, self._finished)
        self.settle()

    def log(self, text: str, level: str = "INFO") -> None:
        """Record a log message; levels are those of the standard library."""
        self._stream.send_columns(
            "/log", self._at(time.time()), row(rr.TextLog(text, level=_LEVELS.get(level, level)))
        )

    def result(self, values: Mapping[str, object]) -> None:
        """Record the run's results, as properties of the recording."""
        send_properties(self._stream, "result", values)

    def close(self, *, merge: bool = True) -> None:
        """Write everything, merge the parts and compact them if requested; a broken recording stays
        unchanged.

        Raises:
          OSError: the file takes no more.
        """
        if self._broken:
            return
        try:
            self._draw()
        finally:
            self._flush()
            end(self._stream)
        if self._path is not None and merge and compact(self._path) and self._finished is not None:
            with_layout(self._path, partial(self._finished.save, APPLICATION))
            release()  # of the layout's file

    def _draw(self) -> None:
        """Send what is held back, all rows of an entity together."""
        waiting, self._reports = self._reports, []
        self._size = 0
        if waiting:
            wall = np.array([came for came, _ in waiting])
            reports = [report for _, report in waiting]
            numbers = np.array([report.generation for report in reports])
            send(
                self._stream,
                self._columns(reports),
                "generation",
                numbers,
                numbers * self._horizon,
                wall,
            )
            before = numbers - 1
            policies = curves.mean_policies([report.progress for report in reports])
            send(self._stream, policies, "generation", before, before * self._horizon, wall)
        rollouts, self._held = self._held, []
        if not rollouts:
            return
        lengths = [len(one.sim) for one in rollouts]
        numbers = np.repeat([one.generation for one in rollouts], lengths)
        sim = np.concatenate([one.sim for one in rollouts])
        wall = np.concatenate([one.wall for one in rollouts])
        captions = self._drawing.captions(
            [(f"generation {one.learnt}", one.rollout) for one in rollouts]
        )
        columns = [*self._drawing.columns(joined([one.rollout for one in rollouts])), *captions]
        send(self._stream, columns, "generation", numbers, sim, wall)
        whole = self._horizon - 0.5 * self._drawing.spec.period
        if early := [one.sim[-1] + SEAM for one in rollouts if one.rollout.times[-1] < whole]:
            send_gaps(self._stream, self._drawing.gaps(len(early)), np.array(early))

    def _columns(self, reports: Sequence[Report]) -> Iterator[Columns]:
        """What some generations have beside rollouts."""
        yield from curves.statistics(reports)
        if self._again is not None:
            yield Columns("/again", markdowns([self._again(report.progress) for report in reports]))
        for name in ("best", "worst"):
            rows = [row for row, report in enumerate(reports) if name in report.traces]
            if rows:
                images = pictures([reports[row].traces[name] for row in rows])
                yield Columns(f"/traces/{name}", images, np.array(rows))
        for number, report in enumerate(reports):
            if "all" in report.traces:
                values = np.ascontiguousarray(report.traces["all"], dtype=np.float32)
                tensor = rr.Tensor(values, dim_names=("rollout", "step", "value"))
                yield Columns(
                    "/traces/all", rr.ComponentColumnList(row(tensor)), np.array([number])
                )

    def _flush(self) -> None:
        """Wait until every row is in the file: a kill loses only what is held back or waits to be
        recorded.
        """
        try:
            flush(self._stream)
        except OSError:
            self._broken = True
            raise

    def _check_space(self) -> None:
        """Stop before the disk is full for Rerun."""
        if self._path is None:
            return
        free = shutil.disk_usage(self._path.parent).free
        if free < RESERVE:
            text = (
                f"{free >> 20} MiB left on the disk of {self._path}, at least {RESERVE >> 20} are"
                " needed"
            )
            raise OSError(errno.ENOSPC, text)

    def _hold(
        self, rollout: Trajectory, generation: int, now: float, learnt: int | None = None
    ) -> None:
        """Hold back a mean policy's rollout, to be written together with the next ones.

        It is shown at a generation, and may be of the policy that was `learnt` in an earlier one.
        """
        start = generation * self._horizon
        wall = now + (rollout.times / self._horizon - 1.0) * min(now - self._last, self._horizon)
        sim = np.minimum(start + rollout.times, start + self._horizon - SEAM)
        self._held.append(
            _Held(generation, generation if learnt is None else learnt, sim, wall, rollout)
        )

    def _at(self, now: float) -> list[rr.TimeColumn]:
        """Start of the generation recorded last; now [s since the epoch]."""
        numbers = np.array([self._generation])
        return times("generation", numbers, numbers * self._horizon, np.array([now]))


@dataclass(frozen=True)
class _Held:
    """A rollout that is held back."""

    generation: int
    learnt: int
    """The generation of its policy."""
    sim: FloatArray
    """Times of the frames on sim_time [s], (F,)"""
    wall: FloatArray
    """Times of the frames on wall_time [s since the epoch], (F,)"""
    rollout: Trajectory
