"""Layouts of the viewer: a learning run, and a replay of rollouts. They travel in the file."""

from collections.abc import Sequence
from typing import Final, Literal

import rerun as rr
import rerun.blueprint as rrb

from farm.tasks.finger_gait.hand import FINGERS
from learner.recording.drawing import Mover

_BACKGROUND: Final = [74, 80, 88, 255]
_EYE: Final = rrb.EyeControls3D(
    kind=rrb.Eye3DKind.Orbital,
    position=(0.275, -0.145, 0.085),
    look_target=(0.03, 0.014, 0.007),
    eye_up=(0, 0, 1),
)
_BESIDE: Final = (0.25, -0.87, 0.42)
"""Where the eye is from what moves in a scene without a hand, as a direction: most walk along x."""
_AWAY: Final = 3.5
"""How far, in its radii."""
_JOINTS: Final = "Joints [rad]: lighter to darker along the finger, targets thin"
_PICTURES: Final = 0.42
"""Height of the pictures below a scene of 1."""


def learning(horizon: float, *, touch: bool = True, mover: Mover | None = None) -> rrb.Blueprint:
    """Layout of a run.

    Args:
      horizon: of a rollout [s]; the rollout's curves show so much to either side of the cursor.
      touch: whether there are fingertips, and success; without them it is any scene.
      mover: what to look at in any scene.
    """
    name = "The mean policy's rollout"
    if not touch:
        tabs = rrb.Tabs(_learning(touch=False), rrb.Vertical(*_plain(horizon), name="Rollout"), _config())
        parts = rrb.Horizontal(_plain_scene(name, mover), tabs, column_shares=[0.45, 0.55])
        return _blueprint(parts, "generation", "following")
    left = rrb.Vertical(
        _scene(name),
        rrb.Horizontal(
            *_fingertips(),
            _picture("/tactile/trace/best", "Best"),
            _picture("/tactile/trace/worst", "Worst"),
        ),
        row_shares=[1.0, _PICTURES],
    )
    tabs = rrb.Tabs(_learning(), rrb.Vertical(*_curves(horizon), name="Rollout"), _config())
    return _blueprint(rrb.Horizontal(left, tabs, column_shares=[0.45, 0.55]), "generation", "following")


def replay(horizon: float, *, touch: bool = True, mover: Mover | None = None) -> rrb.Blueprint:
    """Layout of rollouts that are played one after the other, with a window of `horizon` [s]; else as `learning`."""
    if not touch:
        shown = rrb.TextDocumentView(origin="/rollout", name="Shown")
        tabs = rrb.Tabs(rrb.Vertical(shown, *_plain(horizon), name="Rollout"), _config())
        parts = rrb.Horizontal(_plain_scene("Replay", mover), tabs, column_shares=[0.6, 0.4])
        return _blueprint(parts, "sim_time", "playing")
    left = rrb.Vertical(
        _scene("Replay"),
        rrb.Horizontal(rrb.TextDocumentView(origin="/rollout", name="Shown"), *_fingertips()),
        row_shares=[1.0, _PICTURES],
    )
    tabs = rrb.Tabs(rrb.Vertical(*_curves(horizon), name="Rollout"), _config())
    return _blueprint(rrb.Horizontal(left, tabs, column_shares=[0.6, 0.4]), "sim_time", "playing")


def comparison(roots: Sequence[str], spacing: float) -> rrb.Blueprint:
    """Layout of several runs, each below its root, their hands so far apart [m]."""
    middle, count = 0.5 * spacing * (len(roots) - 1), len(roots)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(0.2 + 0.1 * count, middle - 0.05 * count, 0.04 + 0.03 * count),
        look_target=(0.03, middle + 0.02, 0.03),
        eye_up=(0, 0, 1),
    )
    hands = rrb.Spatial3DView(
        origin="/",
        contents=[f"+ {root}/{part}" for root in roots for part in ("world/**", "label")],
        name="Final policies: play the timeline sim_time",
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )
    ends = rr.TimeRangeBoundary.infinite()
    whole = rrb.TimeAxis(view_range=rr.TimeRange(start=ends, end=ends))  # also after a change of the timeline
    left = rrb.Vertical(hands, rrb.TextDocumentView(origin="/table", name="Runs"), row_shares=[1.0, 1.0])

    def plot(name: str, entity: str, legend: rrb.Corner2D | None = None) -> rrb.View:
        return _plot(name, *(f"{root}/{entity}" for root in roots), legend=legend, axis_x=whole)

    learning = rrb.Vertical(
        plot("Return of the mean policy", "return", legend=rrb.Corner2D.RightBottom),
        plot("Return of the exploring rollouts, mean ± std", "band"),
        rrb.Horizontal(plot("Success of the exploring rollouts", "success"), plot("Sigma, mean", "sigma")),
        row_shares=[1.5, 1.2, 1],
        name="Learning",
    )
    forces = [plot(f"Force on the {finger} [N]", f"force/{finger}") for finger in FINGERS]
    rollout = rrb.Vertical(
        plot("Reward of a control step", "reward", legend=rrb.Corner2D.RightBottom), *forces, name="Rollout (sim_time)"
    )
    tabs = rrb.Tabs(learning, rollout)
    return _blueprint(rrb.Horizontal(left, tabs, column_shares=[0.5, 0.5]), "generation", "following")


def _blueprint(root: rrb.Container, timeline: str, play: Literal["following", "playing"]) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play),
    )


def _scene(name: str) -> rrb.View:
    return rrb.Spatial3DView(
        origin="/world",
        name=name,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_EYE,
    )


def _plain_scene(name: str, mover: Mover | None) -> rrb.View:
    """Any scene, seen from beside what moves, and a little from above; the eye goes with it."""
    eye = None
    if mover is not None:
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[c + _AWAY * mover.radius * way for c, way in zip(mover.centre, _BESIDE, strict=True)],
            look_target=mover.centre,
            eye_up=(0, 0, 1),
            tracking_entity=mover.entity,
        )
    return rrb.Spatial3DView(
        origin="/world",
        name=name,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _picture(origin: str, name: str) -> rrb.View:
    return rrb.Spatial2DView(origin=origin, name=name, background=[24, 25, 28, 255])


def _fingertips() -> list[rrb.View]:
    return [_picture(f"/tactile/{finger}", finger.capitalize()) for finger in FINGERS]


def _config() -> rrb.View:
    return rrb.TextDocumentView(origin="/config", name="Config")


def _learning(*, touch: bool = True) -> rrb.Container:
    return rrb.Vertical(
        _plot("Return", "/learning/return", "/learning/return_std", legend=rrb.Corner2D.RightBottom),
        rrb.Horizontal(
            *([_plot("Success", "/learning/success")] if touch else []),
            _plot("Sigma", "/learning/sigma"),
            _plot("Norm of mu", "/learning/mean_norm", legend=None),
        ),
        rrb.Horizontal(
            _plot("Farm", "/farm/workers", "/farm/reissued"),
            _plot("Rollouts a second", "/farm/rollouts_per_s", legend=None),
            _plot("Lost rollouts", "/learning/lost"),
        ),
        _log(),
        row_shares=[2.4, 1.1, 1.1, 1],
        name="Learning",
    )


def _plot(
    name: str,
    *entities: str,
    legend: rrb.Corner2D | None = rrb.Corner2D.LeftTop,
    axis_x: rrb.TimeAxis | None = None,
) -> rrb.View:
    shown = rrb.PlotLegend(legend, visible=legend is not None)
    return rrb.TimeSeriesView(name=name, contents=list(entities), plot_legend=shown, axis_x=axis_x)


def _log() -> rrb.View:
    columns = rrb.TextLogColumns(timeline_columns=["generation"], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="/log", name="Log", columns=columns)


def _plain(horizon: float) -> list[rrb.View]:
    window = _window(horizon)
    return [
        rrb.TimeSeriesView(origin=origin, name=name, time_ranges=window)
        for origin, name in (("/reward/terms", "Reward"), ("/actions", "Actions"))
    ]


def _window(horizon: float) -> rr.VisibleTimeRange:
    """So much of a rollout's time to either side of the cursor [s]."""
    return rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-horizon),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=horizon),
    )


def _curves(horizon: float) -> list[rrb.View]:
    window = _window(horizon)
    plots = [
        rrb.TimeSeriesView(origin=origin, name=name, time_ranges=window, plot_legend=legend)
        for origin, name, legend in (
            ("/reward/terms", "Reward terms", rrb.PlotLegend(rrb.Corner2D.LeftBottom)),
            ("/contacts/force", "Fingertip forces [N]", rrb.PlotLegend(rrb.Corner2D.LeftTop)),
            ("/joints", _JOINTS, rrb.PlotLegend(visible=False)),
        )
    ]
    # A window would not move these lanes' axis, only empty the rest of it.
    return [*plots, rrb.StateTimelineView(origin="/contacts/state", name="Contact")]
