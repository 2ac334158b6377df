"""Layouts of the viewer: a learning run, a replay of rollouts, and a comparison of runs.

Stored in the recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from farm.arrays import FloatArray
from farm.sim.channels import Channel
from farm.sim.framing import View
from farm.tasks.base import TaskSpec
from learner.recording.channels import Panel, entities, panels, title
from learner.recording.entities import FOLLOWED

_BACKGROUND: Final = [74, 80, 88, 255]
_DARK: Final = [24, 25, 28, 255]
_NEARER: Final = 0.88  # Rerun's eye sees a wider field than MuJoCo's camera
_PICTURES: Final = 0.42  # height of the pictures below a scene of 1
_CAPTION: Final = 0.16  # and of a caption alone
_LEGEND: Final = 6  # no legend for more curves than this: it would hide them
_MARGIN: Final = 1.6  # number of rollouts shown before the cursor; the legend covers older ones
_FIRST: Final = 1.2  # height of the first plots, whose legend is mostly the longest; of others 1
_ROWS: Final = 3  # more plots of a rollout are in two columns


@dataclass(frozen=True)
class Eye:
    """The eye of a scene's view."""

    target: FloatArray
    """[m], (3,)"""
    away: FloatArray
    """From the target to the eye [m], (3,)"""
    tracked: str | None = None
    """Entity that the eye follows."""

    @classmethod
    def of(cls, view: View) -> "Eye":
        """The eye of a point of view: it follows what that follows."""
        camera = view.camera
        a, e = np.deg2rad([camera.azimuth, camera.elevation])
        ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        tracked = None if view.mover is None else FOLLOWED
        return cls(np.array(camera.lookat), -_NEARER * camera.distance * ahead, tracked)


def learning(spec: TaskSpec, eye: Eye) -> rrb.Blueprint:
    """Layout of a run while it learns: the newest generation is in view."""
    return _blueprint(
        _run(spec, eye, "The mean policy's rollout"),
        rrb.TimePanel(timeline="generation", play_state="following"),
    )


def finished(spec: TaskSpec, eye: Eye) -> rrb.Blueprint:
    """Layout of a finished run: its curves over the generations, and the end of its policy's
    rollout.

    All views are drawn on one timeline, and curves read best over generations; rollouts move on
    sim_time.
    """
    scene = "The run's policy: it moves on the timeline sim_time"
    panel = rrb.TimePanel(timeline="generation", play_state="following")
    return _blueprint(_run(spec, eye, scene), panel)


def _run(spec: TaskSpec, eye: Eye, scene: str) -> rrb.Container:
    """`scene` is the name of the scene's view."""
    pictures = rrb.Horizontal(*_images(spec), name="Images")
    traces = rrb.Horizontal(
        _picture("/traces/best", "Best"), _picture("/traces/worst", "Worst"), name="Traces"
    )
    parts = [
        part
        for part, present in ((pictures, bool(_images(spec))), (traces, bool(spec.trace_channels)))
        if present
    ]
    left = [_scene(scene, eye), *([rrb.Tabs(*parts)] if len(parts) > 1 else parts)]
    again = rrb.TextDocumentView(origin="/again", name="Again")
    horizon = spec.steps * spec.period
    tabs = rrb.Tabs(
        _learning(spec), _rollout(spec, horizon, "Rollout (sim_time)"), _farm(), again, _config()
    )
    return _beside(left, _PICTURES, tabs, 0.45)


def replay(spec: TaskSpec, eye: Eye, window: float) -> rrb.Blueprint:
    """Layout of rollouts that are played one after the other; curves show `window` [s] around
    the cursor.
    """
    caption = rrb.TextDocumentView(origin="/rollout", name="Shown")
    images = _images(spec)
    below = rrb.Horizontal(caption, *images) if images else caption
    tabs = rrb.Tabs(_rollout(spec, window, "Rollout"), _config())
    left = [_scene("Replay", eye), below]
    return _blueprint(_beside(left, _PICTURES if images else _CAPTION, tabs, 0.5), _playing())


def comparison(
    roots: Sequence[str], eye: Eye, compared: Channel | None, *, success: bool, learning: bool
) -> rrb.Blueprint:
    """Layout of several runs, each below its root; `compared` are scalars common to all, drawn
    label by label.

    Without `learning` they are rollouts, which have no learning curves.
    """
    contents = [f"+ {root}/{part}" for root in roots for part in ("world/**", "label")]
    scenes = _scene(
        "Final policies: play the timeline sim_time" if learning else "Rollouts", eye, "/", contents
    )
    left = [scenes, rrb.TextDocumentView(origin="/table", name="Runs" if learning else "Rollouts")]

    def plot(name: str, entity: str, legend: rrb.Corner2D | None = None) -> rrb.View:
        return _plot(name, *(f"{root}/{entity}" for root in roots), legend=legend)

    whole_run = rrb.Vertical(
        plot("Return of the mean policy", "return", legend=rrb.Corner2D.RightBottom),
        plot("Return of the exploring rollouts, mean ± std", "band"),
        rrb.Horizontal(
            *([plot("Success of the exploring rollouts", "success")] if success else []),
            plot("Sigma, mean", "sigma"),
        ),
        row_shares=[1.5, 1.2, 1],
        name="Learning",
    )
    curves = [plot("Reward of a control step", "reward", legend=rrb.Corner2D.RightBottom)]
    if compared is not None:
        labelled = zip(compared.names, entities(compared), strict=True)
        curves += [plot(f"{title(compared)}: {label}", entity[1:]) for label, entity in labelled]
    rollout = _stacked(curves, [], "Rollout (sim_time)")
    if not learning:
        return _blueprint(_beside(left, _PICTURES, rollout, 0.6), _playing())
    following = rrb.TimePanel(timeline="generation", play_state="following")
    return _blueprint(_beside(left, 1.0, rrb.Tabs(whole_run, rollout), 0.5), following)


def _blueprint(root: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    time.state = "collapsed"
    return rrb.Blueprint(
        root, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"), time
    )


def _playing() -> rrb.TimePanel:
    return rrb.TimePanel(timeline="sim_time", play_state="playing", loop_mode="all")


def _beside(
    left: Sequence[rrb.View | rrb.Container], below: float, right: rrb.Container, share: float
) -> rrb.Container:
    """A scene with a view of that height below it, if there is one, and tabs to its right."""
    column = rrb.Vertical(*left, row_shares=[1.0, below][: len(left)])
    return rrb.Horizontal(column, right, column_shares=[share, 1.0 - share])


def _scene(
    name: str, eye: Eye, origin: str = "/world", contents: Sequence[str] = ("$origin/**",)
) -> rrb.View:
    controls = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=eye.target + eye.away,
        look_target=eye.target,
        eye_up=(0, 0, 1),
        tracking_entity=eye.tracked,
    )
    return rrb.Spatial3DView(
        origin=origin,
        contents=list(contents),
        name=name,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=controls,
    )


def _picture(origin: str, name: str) -> rrb.View:
    return rrb.Spatial2DView(origin=origin, name=name, background=_DARK)


def _images(spec: TaskSpec) -> list[rrb.View]:
    return [_picture(each.origin, each.name) for each in panels(spec.channels, "picture")]


def _config() -> rrb.View:
    return rrb.TextDocumentView(origin="/config", name="Config")


def _learning(spec: TaskSpec) -> rrb.Container:
    """Learning curves with legends where curves seldom are: returns rise, sigma falls."""
    bottom, top = rrb.Corner2D.RightBottom, rrb.Corner2D.RightTop
    log = rrb.TextLogColumns(timeline_columns=["generation"], text_log_columns=["loglevel", "body"])
    policies = [f"/learning/mean_policy/{name}" for name in ("return", "validation")]
    returns = ("/learning/return", "/learning/return_std", *policies)
    rates = ("/learning/success", "/learning/mean_policy/success")
    measures = [
        _plot(
            f"{each.name} [{each.unit}]" if each.unit else each.name,
            f"/learning/measures/{each.name}",
            f"/learning/mean_policy/measures/{each.name}",
            legend=bottom,
        )
        for each in spec.measures
    ]
    return rrb.Vertical(
        _plot("Return", *returns, legend=bottom),
        *([rrb.Horizontal(*measures)] if measures else []),
        rrb.Horizontal(
            *([_plot("Success", *rates, legend=bottom)] if spec.success else []),
            _plot("Sigma", "/learning/sigma", legend=top),
            _plot("Norm of mu", "/learning/mean_norm", legend=None),
        ),
        rrb.TextLogView(origin="/log", name="Log", columns=log),
        row_shares=[2.2, *([1.4] if measures else []), 1.4, 1],
        name="Learning",
    )


def _farm() -> rrb.Container:
    """One curve per plot, without a legend; lost rollouts are mostly zero."""
    top = rrb.Corner2D.RightTop
    return rrb.Vertical(
        _plot("Workers", "/farm/workers", legend=None),
        _plot("Rollouts per second", "/farm/rollouts_per_s", legend=None),
        _plot("Lost rollouts", "/learning/lost", legend=top),
        _plot("Reissued jobs", "/farm/reissued", legend=None),
        name="Farm",
    )


def _plot(
    name: str, *entities: str, legend: rrb.Corner2D | None = rrb.Corner2D.LeftTop
) -> rrb.View:
    """Curves over all their time, also while the cursor moves and after a change of the
    timeline.
    """
    ends = rr.TimeRangeBoundary.infinite()
    whole = rrb.TimeAxis(view_range=rr.TimeRange(start=ends, end=ends))
    key = rrb.PlotLegend(legend, visible=legend is not None)
    return rrb.TimeSeriesView(name=name, contents=list(entities), plot_legend=key, axis_x=whole)


def _rollout(spec: TaskSpec, horizon: float, name: str) -> rrb.Container:
    """Curves and lanes of a rollout, `horizon` [s] to either side of the cursor."""
    window = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-_MARGIN * horizon),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=horizon),
    )
    curves = [
        Panel("curves", "/reward/terms", "Reward terms", len(spec.terms)),
        Panel("curves", "/actions", "Actions", spec.action),
        *panels(spec.channels, "curves"),
    ]
    plots: list[rrb.View] = [
        rrb.TimeSeriesView(
            origin=each.origin,
            name=each.name,
            time_ranges=window,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=each.legend <= _LEGEND),
        )
        for each in curves
    ]
    # A window would not move these lanes' axis, only clear the rest of it.
    lanes: list[rrb.View] = [
        rrb.StateTimelineView(origin=each.origin, name=each.name)
        for each in panels(spec.channels, "lanes")
    ]
    return _stacked(plots, lanes, name)


def _stacked(views: list[rrb.View], lanes: list[rrb.View], name: str) -> rrb.Container:
    """Plots below each other, many in pairs, so that their legends fit; lanes below them."""
    each = 1 if len(views) <= _ROWS else 2
    pairs = [rrb.Horizontal(*views[i : i + each]) for i in range(0, len(views), each)]
    rows = [*(pairs if each > 1 else views), *lanes]
    return rrb.Vertical(*rows, row_shares=[_FIRST, *[1.0] * (len(rows) - 1)], name=name)
