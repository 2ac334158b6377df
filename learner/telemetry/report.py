"""The report of a finished generation, and its message."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from farm.arrays import AnyArray
from farm.errors import MessageError
from farm.net.stats import GenerationStats
from farm.net.telemetry import Line, RunReport, Trace
from farm.net.work import WireTrajectory
from farm.sim.trajectory import Trajectory


@dataclass(frozen=True)
class Report:
    """A finished generation."""

    progress: GenerationStats
    rate: float
    """Rollouts per second in this generation."""
    sample: Trajectory | None
    """The mean policy's rollout."""
    traces: Mapping[str, AnyArray]
    """Traces: `best` and `worst` (T, N), and `all` (2N, T, N) if the run keeps them."""
    replay: Trajectory | None
    """The best rollout so far at physics rate, if there is a new one."""
    replay_generation: int
    """The generation of the replayed rollout."""


def packed(report: Report, run: str, incarnation: str, lines: tuple[Line, ...]) -> RunReport:
    """A report's message, with the log messages since the previous one."""
    traces = {name: values if name == "all" else values[None] for name, values in report.traces.items()}
    return RunReport(
        run=run,
        incarnation=incarnation,
        generation=report.progress.generation,
        progress=report.progress.to_dict(),
        rate=report.rate,
        lines=lines,
        # Copies: a slice would keep the traces of the whole generation in memory.
        traces=tuple(Trace(name=name, values=np.array(values, "<f4")) for name, values in traces.items()),
        sample=wire(report.sample),
        replay=wire(report.replay),
        replay_generation=report.replay_generation,
    )


def unpacked(message: RunReport) -> Report:
    """The report in a message; a MessageError if its progress is invalid."""
    try:
        progress = GenerationStats.from_dict(message.progress)
    except ValueError as error:
        raise MessageError(f"RunReport: {error}") from None
    if progress.generation != message.generation:
        raise MessageError(f"RunReport: generation {message.generation} with the progress of {progress.generation}")
    return Report(
        progress=progress,
        rate=message.rate,
        sample=message.sample.trajectory() if message.sample else None,
        traces={trace.name: trace.values if trace.name == "all" else trace.values[0] for trace in message.traces},
        replay=message.replay.trajectory() if message.replay else None,
        replay_generation=message.replay_generation,
    )


def wire(trajectory: Trajectory | None) -> WireTrajectory | None:
    """A trajectory for sending."""
    return None if trajectory is None else WireTrajectory.of(trajectory)
