"""Several runs, or rollouts of one, in one recording: scenes side by side, curves over each other.

    /runs/<name>                 position of its scene (static)
    /runs/<name>/world/...       the final policy's rollout, as in a run's own recording
    /runs/<name>/return, /band, /success, /sigma     learning curves (of runs)
    /runs/<name>/reward, /<channel>/<label>          of the rollout

The first channel of scalars is drawn, if all runs have it. Curves are on the timelines `generation`
and `rollouts`, rollouts on `sim_time`; on the first two the scenes show the ends of the rollouts.
Rollouts of one run are below `/rollouts` in the same way.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray
from farm.net.stats import GenerationStats
from farm.replacing import replacing
from farm.sim.channels import Channel
from farm.sim.trajectory import Trajectory
from learner.recording import blueprint
from learner.recording.channels import entities
from learner.recording.curves import Colour, band, lines, numbers, palette
from learner.recording.drawing import Drawing
from learner.recording.eye import Eye
from learner.recording.rows import file_sink, log_static, markdown, recording, times

_APPLICATION: Final = "rolloutfarm comparison"  # a separate layout, which is never used for a run
_BESIDE: Final = "rolloutfarm rollouts"
# Azimuth and elevation [deg]: robots that walk along x come towards the eye
_VIEW: Final = (160.0, -15.0)
_SPACING: Final = 1.35  # in radii of the largest scene
_WIDER: Final = 0.55  # the eye's additional distance per further scene, in spacings


@dataclass(frozen=True)
class Side:
    """Side of a comparison: a run and its final policy's rollout, or any rollout with its own
    name.
    """

    name: str
    drawing: Drawing
    progress: Sequence[GenerationStats]
    rollout: Trajectory


def record_comparison(
    path: Path, runs: Sequence[Side], table: str, *, rollouts_of: str = ""
) -> None:
    """Write the recording of runs, or of the rollouts of one run with this name, with a table of
    them (Markdown).

    Rollouts of one run have no learning curves.

    Raises:
      OSError: the file cannot be written; an existing one stays.
    """
    learning = not rollouts_of
    name, above = ("comparison", "/runs") if learning else (f"{rollouts_of}-replay", "/rollouts")
    roots = [f"{above}/{rr.escape_entity_path_part(run.name)}" for run in runs]
    step, eye = _arrangement(runs)
    compared = _compared(runs)
    success = any(run.drawing.spec.success for run in runs)
    layout = blueprint.comparison(roots, eye, compared, success=success, learning=learning)
    application = _APPLICATION if learning else _BESIDE
    with (
        replacing(path) as aside,
        recording(name, [file_sink(aside)], layout, application) as stream,
    ):
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("/table", markdown(table), static=True)
        for number, (root, run, colour) in enumerate(
            zip(roots, runs, palette(len(runs)), strict=True)
        ):
            world = [
                (root + entity, value)
                for entity, value in run.drawing.static()
                if entity.startswith("/world/")
            ]
            names = [
                (root + entity, value)
                for entity, value in _names(run, colour, compared, learning=learning)
            ]
            log_static(stream, [(root, rr.Transform3D(translation=number * step)), *world, *names])
            if learning:
                _send_curves(stream, root, run.progress, run.rollout.returned)
            _send_rollout(stream, root, run, compared)


def _arrangement(runs: Sequence[Side]) -> tuple[FloatArray, Eye]:
    """The vector from each scene to the next [m] (3,), across the line of sight; and the eye
    that sees all of them.
    """
    sizes = [run.drawing.scene.radius for run in runs]
    largest = runs[int(np.argmax(sizes))].drawing
    view = largest.view([run.rollout for run in runs if run.drawing is largest])
    if largest.camera is None:
        view.camera = replace(view.camera, azimuth=_VIEW[0], elevation=_VIEW[1])
    eye = Eye.of(view)
    along_y = abs(eye.away[0]) >= abs(eye.away[1])
    step = _SPACING * max(sizes) * np.array([0.0, 1.0, 0.0] if along_y else [1.0, 0.0, 0.0])
    further = len(runs) - 1
    wider = 1.0 + _WIDER * further * float(np.linalg.norm(step)) / view.camera.distance
    return step, Eye(eye.target + 0.5 * further * step, eye.away * wider)


def _compared(runs: Sequence[Side]) -> Channel | None:
    """The first channel of scalars, if all runs have one of its name and labels."""
    first = next(
        (channel for channel in runs[0].drawing.spec.channels if channel.kind == "scalars"), None
    )
    channels = [{(c.name, c.kind, c.names) for c in run.drawing.spec.channels} for run in runs]
    return (
        first
        if first and all((first.name, first.kind, first.names) in names for names in channels)
        else None
    )


def _names(
    run: Side, colour: Colour, compared: Channel | None, *, learning: bool
) -> Iterator[tuple[str, Any]]:
    """Static entities besides the scene: names and the run's colour."""
    size = run.drawing.scene.radius
    above = Eye.of(run.drawing.view()).target + (0.0, 0.0, size)
    point = rr.Points3D(
        [above], labels=[run.name], colors=[colour], radii=[0.02 * size], show_labels=True
    )
    yield "/label", point
    if learning:
        yield "/return", lines((run.name,), (colour,), width=2.5)
        yield (
            "/band",
            rr.Measurements.from_fields(
                names=f"{run.name}, exploring ± std", colors=[colour], widths=[1.0]
            ),
        )
    curves = ("/success", "/sigma") if learning else ()
    for entity in (*curves, "/reward", *(() if compared is None else entities(compared))):
        yield entity, lines((run.name,), (colour,))


def _send_curves(
    stream: rr.RecordingStream, root: str, progress: Sequence[GenerationStats], final: float | None
) -> None:
    """The learning curves.

    A mean policy's return is at the number of updates and rollouts before it.
    """
    at = [
        rr.TimeColumn("generation", sequence=[s.generation for s in progress]),
        rr.TimeColumn("rollouts", sequence=[s.rollouts for s in progress]),
    ]
    behind = [
        rr.TimeColumn(
            "generation", sequence=[s.generation - 1 for s in progress] + [progress[-1].generation]
        ),
        rr.TimeColumn("rollouts", sequence=[0] + [s.rollouts for s in progress]),
    ]
    returns = numbers([s.mean_policy_return for s in progress] + [final])
    stream.send_columns(f"{root}/return", behind, rr.Scalars.columns(scalars=returns))
    for entity, values in (
        ("/success", [s.success_rate for s in progress]),
        ("/sigma", [s.sigma_mean for s in progress]),
    ):
        stream.send_columns(root + entity, at, rr.Scalars.columns(scalars=numbers(values)))
    stream.send_columns(f"{root}/band", at, band(progress))


def _send_rollout(
    stream: rr.RecordingStream, root: str, run: Side, compared: Channel | None
) -> None:
    """The rollout's frames; on the timelines of the curves all exist from the start."""
    rollout = run.rollout
    before = np.zeros(len(rollout.times), dtype=np.int64)
    at = [*times("generation", before, rollout.times), rr.TimeColumn("rollouts", sequence=before)]
    for part in run.drawing.columns(rollout):
        if part.entity.startswith("/world/"):
            stream.send_columns(root + part.entity, at, part.columns)
    curves = {"/reward": rollout.terms.sum(axis=-1)}
    if compared is not None:
        curves |= dict(zip(entities(compared), rollout.channels[compared.name].T, strict=True))
    for entity, values in curves.items():
        stream.send_columns(root + entity, at[1:2], rr.Scalars.columns(scalars=numbers(values)))
