"""Layouts of the viewer: a learning run, and a replay of rollouts. They travel in the file."""

from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from farm.hand import FINGERS

_BACKGROUND: Final = [74, 80, 88, 255]
_EYE: Final = rrb.EyeControls3D(
    kind=rrb.Eye3DKind.Orbital, position=(0.30, -0.16, 0.14), look_target=(0.035, 0.02, 0.01), eye_up=(0, 0, 1)
)
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


def _blueprint(root: rrb.Container, timeline: str, play: str) -> rrb.Blueprint:
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
    returns = rrb.TimeSeriesView(
        name="Return",
        contents=["/learning/return", "/learning/return_std"],
        plot_legend=rrb.Corner2D.LeftTop,
    )
    shares = rrb.TimeSeriesView(
        origin="/learning/success",
        name="Success",
        axis_y=rrb.ScalarAxis(range=(-0.05, 1.05)),
        plot_legend=rrb.Corner2D.LeftTop,
    )
    return rrb.Vertical(
        returns,
        rrb.Horizontal(shares, _plot("/learning/lost", "Lost rollouts")),
        rrb.Horizontal(_plot("/learning/sigma", "Sigma"), _plot("/learning/mean_norm", "Norm of mu")),
        rrb.Horizontal(
            rrb.TimeSeriesView(
                name="Farm",
                contents=["/farm/workers", "/farm/reissued"],
                plot_legend=rrb.Corner2D.LeftTop,
            ),
            _plot("/farm/rollouts_per_s", "Rollouts a second"),
        ),
        _log(),
        row_shares=[2.2, 1, 1, 1, 1],
        name="Learning",
    )


def _plot(origin: str, name: str) -> rrb.View:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.Corner2D.LeftTop)


def _log() -> rrb.View:
    return rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(timeline_columns=["generation"], text_log_columns=["loglevel", "body"]),
    )


def _curves(horizon: float) -> list[rrb.View]:
    window = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-horizon),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=horizon),
    )
    plots = [
        rrb.TimeSeriesView(origin=origin, name=name, time_ranges=window, plot_legend=corner)
        for origin, name, corner in (
            ("/reward/terms", "Reward terms", rrb.Corner2D.LeftBottom),
            ("/contacts/force", "Force on the fingertips [N]", rrb.Corner2D.LeftTop),
            ("/joints", "Joints [rad]: position (thick), target (thin)", rrb.Corner2D.LeftTop),
        )
    ]
    lanes = rrb.StateTimelineView(origin="/contacts/state", name="Contact", time_ranges=window)
    return [*plots, lanes]
