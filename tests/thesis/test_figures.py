"""Figures of experiments."""

import re
from dataclasses import replace

import numpy as np
import pytest
from trials import made

from benchmarks.thesis import claims
from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.experiment import (
    UNDECIDED,
    UNTESTABLE,
    Chain,
    Curves,
    Data,
    Experiment,
    Friction,
    KernelError,
    Transfer,
    judge,
)
from benchmarks.thesis.setups import config
from learner.run.config import RunConfig


@pytest.mark.parametrize(
    "name", ["fig-4.1", "fig-4.2", "fig-4.6", "objects", "friction", "chain", "table-3.2"]
)
def test_every_kind_of_figure_can_be_drawn_and_says_what_failed(tmp_path, name):
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import draw

    experiment = EXPERIMENTS[name]
    count, rng = len(experiment.curves), np.random.default_rng(0)
    curves = [made(-10 * rng.random((5, 30)), rng.random((5, 30)) > 0.5) for _ in range(count)]
    if curves:
        broken = {k: np.where(np.arange(30) < 12, v, np.nan) for k, v in curves[0].columns.items()}
        curves[0] = replace(
            curves[0], columns=broken, states=("finished",) * 3 + ("diverged", "missing")
        )
    series = dict(zip(experiment.curves, curves, strict=True))
    configs = {label: config(name) for label, name in experiment.curves.items()}
    paths = draw(experiment, Data(series, measurements(experiment, count), configs), tmp_path)
    assert all(path.stat().st_size > 5000 for path in paths)
    svg = " ".join(re.sub("<[^>]*>", " ", paths[1].read_text()).split())
    assert experiment.title in svg
    assert not curves or "trial 3 diverged" in svg
    if name != "fig-4.1":
        return
    again = paths[1].read_bytes()
    assert (
        draw(experiment, Data(series, measurements(experiment, count), configs), tmp_path)[
            1
        ].read_bytes()
        == again
    )


def test_a_figure_keeps_the_numbers_that_are_read() -> None:
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import shortened

    svg = (
        '<path d="M 12.345678 -0.123456 L 7.5 8" transform="scale(0.015625)"/><text'
        ' x="100.987654">1.12345</text>'
    )
    assert (
        shortened(svg) == '<path d="M 12.35 -0.123456 L 7.5 8" transform="scale(0.015625)"/><text'
        ' x="100.99">1.12345</text>'
    )


def measurements(experiment: Experiment, count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    figure = experiment.figure
    if isinstance(figure, Transfer):
        return {"transfer": rng.random((count, 5, len(figure.objects)))}
    if isinstance(figure, Friction):
        return {
            "success": rng.random((count, 5, len(figure.factors))),
            "factors": np.array(figure.factors),
        }
    if isinstance(figure, Chain):
        return {
            "reached": rng.random((5, 9)),
            "acting": np.arange(20) % 2,
            "force": rng.random((20, 3)),
        }
    if isinstance(figure, KernelError):
        sizes = np.array(claims.SIZES)
        return {
            "error": rng.random((4, len(figure.features))),
            "sizes": sizes,
            "features": np.array(figure.features),
        }
    assert isinstance(figure, Curves)
    return {"action": 1 + rng.random((count, 5, 30)), "saturated": rng.random((count, 5, 30))}


@pytest.mark.parametrize("name", [name for name, e in EXPERIMENTS.items() if e.find])
def test_every_claim_is_held_against_any_data(name):
    experiment = EXPERIMENTS[name]
    count = len(experiment.curves)
    rng = np.random.default_rng(2)
    curves = [made(-10 * rng.random((5, 30)), rng.random((5, 30)) > 0.5) for _ in range(count)]
    series = dict(zip(experiment.curves, curves, strict=True))
    assert experiment.find
    data = Data(series, measurements(experiment, count), dict.fromkeys(series, RunConfig()))
    findings = judge(experiment, data)
    assert findings
    # One that ended after three generations is judged as well, one that is missing not at all
    if series:
        label, first = next(iter(series.items()))
        short = {
            k: np.where((np.arange(5) == 4)[:, None] & (np.arange(30) > 2), np.nan, v)
            for k, v in first.columns.items()
        }
        series[label] = replace(first, columns=short, states=("finished",) * 4 + ("diverged",))
        assert judge(experiment, data)
        series[label] = replace(first, states=("finished",) * 4 + ("missing",))
        assert judge(experiment, data) == []
    assert all(finding.holds in (True, False, UNDECIDED, UNTESTABLE) for finding in findings)
    assert all(finding.part and finding.numbers for finding in findings)
