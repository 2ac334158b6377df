"""Layouts of the viewer: a learning run, and a replay of rollouts. They travel in the file."""

from typing import Final, Literal

import rerun as rr
import rerun.blueprint as rrb

from farm.hand import FINGERS

_BACKGROUND: Final = [74, 80, 88, 255]
_EYE: Final = rrb.EyeControls3D(
    kind=rrb.Eye3DKind.Orbital,
    position=(0.275, -0.145, 0.085),
    look_target=(0.03, 0.014, 0.007),
    eye_up=(0, 0, 1),
)
_JOINTS: Final = "Joints [rad]: lighter to darker along the finger, targets thin"
_PICTURES: Final = 0.42
"""Height of the pictures below a scene of 1."""


def learning(horizon: float) -> rrb.Blueprint:
    """Layout of a run.

    Args:
      horizon: of a rollout [s]; the rollout's curves show so much to either side of the cursor.
    """
    left = rrb.Vertical(
        _scene("The mean policy's rollout"),
        rrb.Horizontal(
            *_fingertips(),
            _picture("/tactile/trace/best", "Best"),
            _picture("/tactile/trace/worst", "Worst"),
        ),
        row_shares=[1.0, _PICTURES],
    )
    tabs = rrb.Tabs(_learning(), rrb.Vertical(*_curves(horizon), name="Rollout"), _config())
    return _blueprint(rrb.Horizontal(left, tabs, column_shares=[0.45, 0.55]), "generation", "following")


def replay(horizon: float) -> rrb.Blueprint:
    """Layout of rollouts that are played one after the other, with a window of `horizon` [s]."""
    left = rrb.Vertical(
        _scene("Replay"),
        rrb.Horizontal(rrb.TextDocumentView(origin="/rollout", name="Shown"), *_fingertips()),
        row_shares=[1.0, _PICTURES],
    )
    tabs = rrb.Tabs(rrb.Vertical(*_curves(horizon), name="Rollout"), _config())
    return _blueprint(rrb.Horizontal(left, tabs, column_shares=[0.6, 0.4]), "sim_time", "playing")


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


def _picture(origin: str, name: str) -> rrb.View:
    return rrb.Spatial2DView(origin=origin, name=name, background=[24, 25, 28, 255])


def _fingertips() -> list[rrb.View]:
    return [_picture(f"/tactile/{finger}", finger.capitalize()) for finger in FINGERS]


def _config() -> rrb.View:
    return rrb.TextDocumentView(origin="/config", name="Config")


def _learning() -> rrb.Container:
    return rrb.Vertical(
        _plot("Return", "/learning/return", "/learning/return_std", legend=rrb.Corner2D.RightBottom),
        rrb.Horizontal(
            _plot("Success", "/learning/success"),
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


def _plot(name: str, *entities: str, legend: rrb.Corner2D | None = rrb.Corner2D.LeftTop) -> rrb.View:
    shown = rrb.PlotLegend(legend, visible=legend is not None)
    return rrb.TimeSeriesView(name=name, contents=list(entities), plot_legend=shown)


def _log() -> rrb.View:
    columns = rrb.TextLogColumns(timeline_columns=["generation"], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="/log", name="Log", columns=columns)


def _curves(horizon: float) -> list[rrb.View]:
    window = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-horizon),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=horizon),
    )
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
