"""What is found in series of trials, and what chance would do."""

import numpy as np
import pytest
from trials import made, rising

from benchmarks.thesis import claims, shapes, statistics
from benchmarks.thesis.experiment import (
    UNDECIDED,
    UNTESTABLE,
    Data,
    Finding,
    verdict,
)
from benchmarks.thesis.folder import ExperimentFolder
from benchmarks.thesis.series import Series
from farm.errors import ConfigError
from learner.run.config import RunConfig


def test_a_verdict():
    yes, no, open_, untestable = (
        Finding("", holds, "") for holds in (True, False, UNDECIDED, UNTESTABLE)
    )
    assert verdict([yes, yes]) == "reproduced"
    assert verdict([yes, no]) == "in part"
    assert verdict([no, no]) == "not reproduced"
    assert verdict([yes, untestable]) == verdict([yes, open_]) == "in part"
    assert verdict([no, open_, untestable]) == "not reproduced"
    assert verdict([open_, untestable]) == "undecided"
    assert verdict([untestable, untestable]) == "cannot be tested"
    assert [finding.answer for finding in (yes, no, open_, untestable)] == [
        "yes",
        "no",
        "undecided",
        "cannot be tested",
    ]


def test_few_trials_decide_only_what_chance_hardly_does():
    low, high = np.array([-5.0, -4.9, -5.1, -5.2, -4.8]), np.array([-1.0, -0.9, -5.0, -1.1, -1.2])
    answer, p = statistics.above(high, low)
    # As large or larger is the sum of the four high ones with any of -4.8, -4.9 and -5.0 (which is
    # there twice).
    assert answer is True
    assert p == pytest.approx(4 / 252)
    assert statistics.above(low, high)[0] is False
    assert statistics.above(low, low + 0.01)[0] == "undecided"
    assert statistics.above(high[:1], low[:1]) == ("undecided", 1.0), "one trial of each"
    assert statistics.all_above((high, low), (low, low + 0.01))[0] == "undecided"
    assert statistics.all_above((high, low), (low, high))[0] is False
    many = np.random.default_rng(0).normal(size=30)
    assert statistics.less_spread(many, 3.0 * many + 7.0)[0] is True
    assert statistics.less_spread(many, many + 7.0)[0] == "undecided"
    assert statistics.above(np.append(high, np.nan), low) == (answer, p), (
        "a missing trial counts for nothing"
    )


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng, inside = np.random.default_rng(5), 0
    for _ in range(100):
        low, high = statistics.difference(rng.normal(1.0, 1.0, 30), rng.normal(0.0, 1.0, 30))
        inside += low <= 1.0 <= high
    assert 88 <= inside <= 99
    assert statistics.share(0, 5) == pytest.approx((0.0, 1.0 - 0.025**0.2))
    assert statistics.share(5, 5) == pytest.approx((0.025**0.2, 1.0))


def test_set_ups_that_never_learn_are_not_compared():
    low, lower = (
        np.full((5, 150), level) + 0.01 * np.arange(5)[:, None] for level in (-5.27, -5.29)
    )
    for claim in (claims.pairs_per_generation, claims.rollouts_count):
        flat = data(made(low, robust=np.zeros(5)), made(lower, robust=np.zeros(5)))
        assert set(holds(claim(flat))) == {UNTESTABLE}
        assert verdict(claim(flat)) == "cannot be tested"
    learnt = made(rising(20, -1), success=np.ones((5, 150)))
    third = claims.states(data(learnt, made(low), made(lower)))[2]
    assert third.holds == UNTESTABLE, (
        "contacts and touch both fail, and the least bit decides nothing"
    )


def test_noise_does_not_make_two_set_ups_equal():
    rng = np.random.default_rng(3)
    for spread, holds in ((2.0, UNDECIDED), (0.1, True)):
        trials = -3.0 + rng.normal(0.0, spread, (2, 5, 1)) + np.zeros((2, 5, 150))
        assert (
            claims.rollouts_count(data(*(made(returns, np.ones((5, 150))) for returns in trials)))[
                1
            ].holds
            == holds
        )


def test_an_experiment_has_its_own_number_of_trials(tmp_path):
    folder = ExperimentFolder.prepare(tmp_path / "e", ["fig-4.3", "fig-4.4"], None, None)
    assert (
        folder.count("joints-D300-30"),
        folder.count("joints-D1500-30"),
        folder.count("joints-D1500"),
    ) == (
        30,
        30,
        5,
    )
    assert len(folder.runs) == 3 * 30 + 3 * 5
    assert ExperimentFolder.open(folder.path) == folder
    with pytest.raises(ConfigError, match="has 30 trials: give as many or more"):
        ExperimentFolder.prepare(folder.path, ["fig-4.3", "fig-4.4"], 5, None)


def data(*series: Series, **measured: np.ndarray) -> Data:
    labels = [chr(97 + i) for i in range(len(series))]
    return Data(
        dict(zip(labels, series, strict=True)), measured, dict.fromkeys(labels, RunConfig())
    )


def holds(findings: list[Finding]) -> list[bool]:
    return [finding.holds for finding in findings]


def test_the_race_to_the_bottom_is_told_from_learning():
    race = rising(80, -20.0)
    race[:, 110:] = -1e6 * np.arange(1, 41)
    factor = np.where(np.arange(150) < 110, 1.0, 500.0) * np.ones((1, 5, 1))
    assert all(holds(claims.race(data(made(race), action=factor))))
    calm = claims.race(data(made(rising(80, -20.0)), action=np.ones((1, 5, 150))))
    assert holds(calm) == [True, True, False, False, True]
    assert holds(claims.race(data(made(rising(20, -20.0)), action=factor)))[0] is False


def test_more_features_learn_faster_or_they_do_not():
    learnt = np.ones((5, 150))
    few = made(rising(151, 0))
    middle = made(rising(90, -5), learnt)
    many = made(rising(40, -1), learnt)
    for curves, expected in (((few, middle, many), True), ((many, middle, few), False)):
        answers = holds(claims.features(data(*curves)))
        assert answers[1] is expected
        assert answers[2] is expected


def test_scaled_returns_are_compared_after_division():
    plain = made(rising(15, -1.5), hashes=tuple("abcde"))
    assert all(holds(claims.scale_free(data(plain, plain, made(100 * rising(15, -1.5))))))
    other = made(100 * rising(16, -1.5), hashes=tuple("abcdf"))
    assert holds(claims.scale_free(data(plain, other, other))) == [False, False, True]


def test_fewer_pairs_learn_sooner_over_rollouts():
    learnt = np.ones((5, 150))
    many = made(rising(50, -1), learnt, rollouts=100)
    few = made(rising(40, -1), learnt, rollouts=30)
    assert holds(claims.rollouts_count(data(many, few)))[0] is True
    slow = made(rising(149, -1), learnt, rollouts=30)
    assert holds(claims.rollouts_count(data(made(rising(5, -1), learnt, rollouts=100), slow))) == [
        False,
        False,
    ]


def test_a_rise_is_one_and_when_it_was():
    flat = -6 + 0.1 * np.random.default_rng(0).random((3, 150))
    np.testing.assert_array_equal(shapes.rise(made(flat)), [np.nan] * 3)
    at = shapes.rise(made(rising(60, -1)))
    assert ((57 <= at) & (at <= 62)).all()


def test_only_what_stays_down_has_fallen():
    up, down = rising(50, -10), rising(50, -10)
    down[:, 100:] = -500
    dip = rising(50, -10)
    dip[:, 80:100] = -500
    assert [bool(shapes.fallen(made(r)).all()) for r in (up, down, dip)] == [False, True, False]
