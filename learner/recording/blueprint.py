"""Layouts of the viewer: a learning run, a replay of rollouts, and a comparison of runs.

Stored in the recording.
"""

import math
from collections.abc import Sequence
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from farm.sim.channels import Channel
from farm.tasks.base import TaskSpec
from learner.recording.channels import Panel, entities, panels, title
from learner.recording.drawing import Drawing
from learner.recording.eye import Eye

_BACKGROUND: Final = [74, 80, 88, 255]
_DARK: Final = [24, 25, 28, 255]
_PICTURES: Final = 0.42  # height of the pictures below a scene of 1
_CAPTION: Final = 0.16  # and of a caption alone
# All legends below each other have at most this number of curves: a longer one would be cut
_LEGEND: Final = 24
_LETTER: Final = 0.009  # width of a legend's letter, in widths of all plots beside each other
_DOT: Final = 0.07  # and of what is beside its letters
_RATES: Final = (-0.7, 1.05)
"""Values that are shown of rates: the legend is below 0, where no curve is."""
_MOST: Final = 0.6  # of a plot that its legend may take
_FIRST: Final = 1.2  # height of the first plots, whose legend is mostly the longest; of others 1
_ROWS: Final = 3  # more plots of a rollout are in two columns


def learning(drawing: Drawing, eye: Eye) -> rrb.Blueprint:
    """Layout of a run while it learns: the newest generation is in view."""
    return _blueprint(
        _run(drawing, eye, "The mean policy's rollout"),
        rrb.TimePanel(timeline="generation", play_state="following"),
    )


def finished(drawing: Drawing, eye: Eye) -> rrb.Blueprint:
    """Layout of a finished run: its curves over the generations, and the end of its policy's
    rollout.

    All views are drawn on one timeline, and curves read best over generations; rollouts move on
    sim_time.
    """
    scene = "The run's policy: it moves on the timeline sim_time"
    panel = rrb.TimePanel(timeline="generation", play_state="following")
    return _blueprint(_run(drawing, eye, scene), panel)


def _run(drawing: Drawing, eye: Eye, scene: str) -> rrb.Container:
    """`scene` is the name of the scene's view."""
    spec = drawing.spec
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
    rollout = _rollout(drawing, horizon, "Rollout (sim_time)")
    tabs = rrb.Tabs(_learning(spec), rollout, _farm(), again, _config())
    return _beside(left, _PICTURES, tabs, 0.45)


def replay(drawing: Drawing, eye: Eye, window: float) -> rrb.Blueprint:
    """Layout of rollouts that are played one after the other; curves show `window` [s] around
    the cursor.
    """
    caption = rrb.TextDocumentView(origin="/rollout", name="Shown")
    images = _images(drawing.spec)
    below = rrb.Horizontal(caption, *images) if images else caption
    tabs = rrb.Tabs(_rollout(drawing, window, "Rollout"), _config())
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
    # No legend, which would cover some: the scenes' names have the curves' colours
    curves = [plot("Reward of a control step", "reward")]
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
    """Learning curves with legends where curves seldom are: returns rise. No corner is free of
    sigma, and its mean is above its min without a legend.

    The band stands for mean, least and greatest return, which are recorded but not drawn.
    """
    bottom = rrb.Corner2D.RightBottom
    log = rrb.TextLogColumns(timeline_columns=["generation"], text_log_columns=["loglevel", "body"])
    policies = [f"/learning/mean_policy/{name}" for name in ("return", "validation")]
    returns = ("/learning/best", "/learning/return_std", *policies)
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
            *([_plot("Success", *rates, legend=bottom, shown=_RATES)] if spec.success else []),
            _plot("Sigma, mean and min", "/learning/sigma", legend=None),
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
    name: str,
    *entities: str,
    legend: rrb.Corner2D | None = rrb.Corner2D.LeftTop,
    shown: tuple[float, float] | None = None,
) -> rrb.View:
    """Curves over all their time, also while the cursor moves and after a change of the timeline;
    with the values from `shown`, or all.
    """
    ends = rr.TimeRangeBoundary.infinite()
    whole = rrb.TimeAxis(view_range=rr.TimeRange(start=ends, end=ends))
    key = rrb.PlotLegend(legend, visible=legend is not None)
    return rrb.TimeSeriesView(
        name=name,
        contents=list(entities),
        plot_legend=key,
        axis_x=whole,
        axis_y=None if shown is None else rrb.ScalarAxis(range=shown),
    )


def _rollout(drawing: Drawing, horizon: float, name: str) -> rrb.Container:
    """Curves and lanes of a rollout, `horizon` [s] to either side of the cursor; left of that is a
    part of each plot that has no curves, for its legend.
    """
    spec = drawing.spec
    curves = [
        Panel("curves", "/reward/terms", "Reward terms", spec.terms),
        Panel("curves", "/actions", "Actions", drawing.actions),
        *panels(spec.channels, "curves"),
    ]
    beside = _columns(len(curves))
    rows = math.ceil(len(curves) / beside)
    plots: list[rrb.View] = []
    for i, each in enumerate(curves):
        alone = beside == 1 or (i == len(curves) - 1 and len(curves) % beside == 1)
        legend = each.legend if len(each.legend) <= _LEGEND // rows else ()
        plots.append(_around_cursor(each, horizon, legend, 1 if alone else beside))
    # A window would not move these lanes' axis, only clear the rest of it.
    lanes: list[rrb.View] = [
        rrb.StateTimelineView(origin=each.origin, name=each.name)
        for each in panels(spec.channels, "lanes")
    ]
    return _stacked(plots, lanes, name)


def _around_cursor(panel: Panel, horizon: float, legend: Sequence[str], beside: int) -> rrb.View:
    """A plot of curves around the cursor; its legend is where none are whole, and `beside` plots
    share the width.
    """
    share = min(beside * legend_width(legend), _MOST)
    whole, view, end = (
        rr.TimeRangeBoundary.cursor_relative(seconds=horizon - width)
        for width in (2.0 * horizon, 2.0 * horizon / (1.0 - share), 0.0)
    )
    return rrb.TimeSeriesView(
        origin=panel.origin,
        name=panel.name,
        time_ranges=rr.VisibleTimeRange("sim_time", start=whole, end=end),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=view, end=end)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=bool(legend)),
    )


def legend_width(entries: Sequence[str]) -> float:
    """Width of a legend, in widths of all plots beside each other; 0 without entries."""
    return _DOT + _LETTER * max(map(len, entries)) if entries else 0.0


def _stacked(views: list[rrb.View], lanes: list[rrb.View], name: str) -> rrb.Container:
    """Plots below each other, many in pairs, so that their legends fit; lanes below them."""
    each = _columns(len(views))
    pairs = [rrb.Horizontal(*views[i : i + each]) for i in range(0, len(views), each)]
    rows = [*(pairs if each > 1 else views), *lanes]
    return rrb.Vertical(*rows, row_shares=[_FIRST, *[1.0] * (len(rows) - 1)], name=name)


def _columns(count: int) -> int:
    """Number of columns for this number of plots."""
    return 1 if count <= _ROWS else 2
