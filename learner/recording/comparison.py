"""Several runs in one recording: learning curves over each other, hands side by side.

    /runs/<name>                 where its hand stands (static)
    /runs/<name>/world/...       the final policy's rollout, as in a run's own recording
    /runs/<name>/return, /band, /success, /sigma     learning curves
    /runs/<name>/force/<finger>, /reward             of the rollout

Curves stand on the timelines `generation` and `rollouts`, rollouts on `sim_time`; on the first two the hands
stay as they are at the rollouts' ends.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray
from farm.net.stats import Progress
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait.hand import FINGERS
from learner.recording import blueprint
from learner.recording.curves import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, Colour, lines
from learner.recording.drawing import Drawing
from learner.recording.rows import begin, flush, log_static

COLOURS: Final = (SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, BLUE)
"""One a run."""

SPACING: Final = 0.22
"""Between two hands [m]."""

_APPLICATION: Final = "rolloutfarm comparison"  # a layout of its own, which never becomes that of a run
_LABEL: Final = (0.0, 0.0, 0.19)  # over the fingers [m]


@dataclass(frozen=True)
class Shown:
    """A run and its final policy's rollout."""

    name: str
    scene: Scene
    progress: Sequence[Progress]
    rollout: Trajectory


def record_comparison(path: Path, runs: Sequence[Shown], table: str) -> None:
    """Write the recording; it may replace one.

    Args:
      path: of the recording.
      runs: at most as many as there are COLOURS.
      table: of the runs, Markdown.

    Raises:
      OSError: the file cannot be written.
    """
    path.touch()  # fails with an errno; Rerun's own error has none
    roots = [f"/runs/{rr.escape_entity_path_part(run.name)}" for run in runs]
    layout = blueprint.comparison(roots, SPACING)
    stream = begin("comparison", [rr.FileSink(path)], layout, _APPLICATION)
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("/table", rr.TextDocument(table, media_type="text/markdown"), static=True)
    for number, (root, run, colour) in enumerate(zip(roots, runs, COLOURS, strict=False)):
        drawing = Drawing(run.scene)
        place = rr.Transform3D(translation=(0.0, number * SPACING, 0.0))
        hand = [(root + entity, value) for entity, value in drawing.static() if entity.startswith("/world/")]
        log_static(stream, [(root, place), *hand, *((root + e, v) for e, v in _names(run.name, colour))])
        _send_curves(stream, root, run.progress)
        _send_rollout(stream, root, drawing, run.rollout)
    flush(stream)
    stream.disconnect()


def _names(name: str, colour: Colour) -> Iterator[tuple[str, Any]]:
    """What never changes but the hand: names and the run's colour."""
    yield "/label", rr.Points3D([_LABEL], labels=[name], colors=[colour], radii=[0.004], show_labels=True)
    yield "/return", lines((name,), (colour,), width=2.5)
    yield "/band", rr.Measurements.from_fields(names=f"{name}, exploring ± std", colors=[colour], widths=[1.0])
    for entity in ("/success", "/sigma", "/reward", *(f"/force/{finger}" for finger in FINGERS)):
        yield entity, lines((name,), (colour,))


def _send_curves(stream: rr.RecordingStream, root: str, progress: Sequence[Progress]) -> None:
    """The learning curves. The mean policy's return and success are those of the mean that was explored around."""
    at = [
        rr.TimeColumn("generation", sequence=[p.generation for p in progress]),
        rr.TimeColumn("rollouts", sequence=[p.rollouts for p in progress]),
    ]
    for entity, values in (
        ("/return", [p.mean_policy_return for p in progress]),
        ("/success", [np.nan if p.success_rate is None else p.success_rate for p in progress]),
        ("/sigma", [p.sigma_mean for p in progress]),
    ):
        stream.send_columns(root + entity, at, rr.Scalars.columns(scalars=values))
    means, spreads = [p.return_mean for p in progress], [p.return_std**2 for p in progress]
    stream.send_columns(f"{root}/band", at, rr.Measurements.columns(values=means, variances=spreads))


def _send_rollout(stream: rr.RecordingStream, root: str, drawing: Drawing, rollout: Trajectory) -> None:
    at = _times(rollout.times)
    for part in drawing.columns(rollout):
        if part.entity.startswith("/world/"):
            stream.send_columns(root + part.entity, at, part.columns)
    forces = rollout.images.sum(axis=-1)
    for finger, force in zip(FINGERS, forces.T, strict=True):
        stream.send_columns(f"{root}/force/{finger}", at[:1], rr.Scalars.columns(scalars=force))
    stream.send_columns(f"{root}/reward", at[:1], rr.Scalars.columns(scalars=rollout.terms.sum(axis=-1)))


def _times(times: FloatArray) -> list[rr.TimeColumn]:
    """Frames in the simulation's time; on the other timelines all are there from the beginning."""
    before = np.zeros(len(times), dtype=np.int64)
    sim = np.rint(times * 1e9).astype("timedelta64[ns]")
    return [
        rr.TimeColumn("sim_time", duration=sim),
        rr.TimeColumn("generation", sequence=before),
        rr.TimeColumn("rollouts", sequence=before),
    ]
