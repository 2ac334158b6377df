"""The viewer's layout: legends cover no curves."""

from dataclasses import replace

import numpy as np
import pytest
import rerun.blueprint as rrb

from farm.tasks.base import Channel
from learner.recording import blueprint
from learner.recording.drawing import Drawing
from learner.recording.eye import Eye

HORIZON = 2.0


def plots(part):
    """All plots of curves in a part of a layout, with the number of those beside each other."""
    beside = isinstance(part, rrb.Horizontal) and len(part.contents) or 1
    for each in part.contents:
        if isinstance(each, rrb.TimeSeriesView):
            yield each, beside
        elif isinstance(each, rrb.Container):
            yield from plots(each)


def rollout_tab(drawing):
    layout = blueprint.replay(drawing, Eye(np.zeros(3), np.ones(3)), HORIZON)
    [tabs] = [each for each in layout.root_container.contents if isinstance(each, rrb.Tabs)]
    return tabs.contents[0]


def seconds(view):
    """Begin and end of a plot's curves and of the plot [s], from the cursor."""
    [curves] = view.properties["VisibleTimeRanges"].ranges.as_arrow_array().to_pylist()
    [axis] = view.properties["TimeAxis"].view_range.as_arrow_array().to_pylist()
    return [
        1e-9 * each
        for each in (curves["range"]["start"], curves["range"]["end"], axis["start"], axis["end"])
    ]


def scalars(name, labels):
    return Channel(name=name, kind="scalars", shape=(len(labels),), labels=labels)


@pytest.mark.parametrize("others", [0, 1, 2, 3])
def test_a_legend_is_where_a_plot_has_no_curves(scene, spec, others):
    more = tuple(scalars(f"more{i}", ("a curve with a long name", "b")) for i in range(others))
    drawing = Drawing(scene, replace(spec, channels=(*spec.channels, *more)))
    shown = list(plots(rollout_tab(drawing)))
    assert len(shown) == 3 + others
    for view, beside in shown:
        first, last, left, right = seconds(view)
        assert (first, last, right) == pytest.approx((-HORIZON, HORIZON, HORIZON))
        names = next(
            (each.names for each in more if view.name == f"{each.name.capitalize()}"), ("1", "2")
        )
        letters = max(map(len, names))  # of a plot 700 pixels wide, 7 for each letter
        assert (first - left) / (right - left) > 7 * letters * beside / 700
        assert view.properties["PlotLegend"].corner.as_arrow_array().to_pylist() == [
            rrb.Corner2D.LeftTop.value
        ]


def test_a_plot_without_a_legend_is_all_curves(scene, spec):
    many = scalars("many", tuple(f"a long name {i}" for i in range(30)))
    drawing = Drawing(scene, replace(spec, channels=(many,)))
    [plot] = [view for view, _ in plots(rollout_tab(drawing)) if view.name == "Many"]
    first, last, left, right = seconds(plot)
    assert plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() == [False]
    assert (left, right) == pytest.approx((first, last))


def test_sigma_has_no_legend_that_could_cover_it(scene, spec):
    layout = blueprint.learning(Drawing(scene, spec), Eye(np.zeros(3), np.ones(3)))
    [sigma] = [view for view, _ in plots(layout.root_container) if view.name.startswith("Sigma")]
    assert sigma.properties["PlotLegend"].visible.as_arrow_array().to_pylist() == [False]


def test_the_legend_of_success_is_below_all_rates(scene, spec):
    drawing = Drawing(scene, replace(spec, success=True))
    layout = blueprint.learning(drawing, Eye(np.zeros(3), np.ones(3)))
    [success] = [view for view, _ in plots(layout.root_container) if view.name == "Success"]
    corner = success.properties["PlotLegend"].corner.as_arrow_array().to_pylist()
    assert corner == [rrb.Corner2D.RightBottom.value]
    [[low, high]] = success.properties["ScalarAxis"].range.as_arrow_array().to_pylist()
    assert low < -0.5, "room for two lines"
    assert high > 1.0
