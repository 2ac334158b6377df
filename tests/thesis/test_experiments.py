"""Experiments as data: the catalogue, series, findings, folders, figures."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import stats

from benchmarks.thesis import claims, series, shapes, statistics
from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.claims import features_for
from benchmarks.thesis.experiment import (
    UNDECIDED,
    UNTESTABLE,
    Chain,
    Curves,
    Data,
    Experiment,
    Finding,
    Friction,
    KernelError,
    Transfer,
    judge,
    trial,
    verdict,
)
from benchmarks.thesis.folder import ExperimentFolder, find
from benchmarks.thesis.series import COLUMNS, Series
from benchmarks.thesis.setups import FITTED, SETUPS, config, setup
from farm.errors import ConfigError
from farm.net import keys
from farm.tasks.standard import nominal
from learner.run.config import RunConfig, configure, to_dict
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.sweep.runs import todo


def made(returns: np.ndarray, success: np.ndarray | None = None, **changes: object) -> Series:
    """A series of these returns, (trials, generations)."""
    count = len(returns)
    columns = {name: returns.astype(float) for name in COLUMNS}
    columns["mean_policy_success"] = np.zeros_like(returns) if success is None else success.astype(float)
    values = {
        "columns": columns, "states": ("finished",) * count, "robust": np.ones(count),
        "succeeded": columns["mean_policy_success"][:, -1] > 0, "final": returns[:, -1].astype(float), "rollouts": 30,
        "seconds": np.ones(count), "hashes": ("",) * count,
    }  # fmt: skip
    return Series(**{**values, **changes})  # type: ignore[arg-type]


# ---------------------------------------------------------------- the catalogue


def test_every_experiment_shows_set_ups_that_exist_and_every_set_up_is_shown():
    shown = {name for experiment in EXPERIMENTS.values() for name in experiment.curves.values()}
    assert shown | {base for base, _ in FITTED.values()} == set(SETUPS) | set(FITTED)
    assert not set(SETUPS) & set(FITTED)


def test_set_ups_are_different_and_their_names_can_be_runs():
    assert all(keys.checked("run", f"{name}-s0") for name in (*SETUPS, *FITTED))
    again = {name for name in SETUPS if name.endswith("-30")} | {"object-bar"}  # a set-up that was learnt once more
    once = [json.dumps(to_dict(config)) for name, config in SETUPS.items() if name not in again]
    assert len(set(once)) == len(once), "two names for one set-up"


@pytest.mark.parametrize("name", ["joints-D300-30", "object-cylinder", "direct-joints-N5", "cosine-joints-D100"])
def test_set_ups_can_be_begun(name):
    assert problem(config(name)).policy.size > 0


def test_a_fitted_start_changes_width_and_first_sigma_or_one_of_them():
    def of(name):
        found = config(name)
        return found.policy_config.bandwidth, found.algorithm_config.initial_sigma

    printed, both = of("contacts-D1500"), of("contacts-D1500-fitted")
    assert printed == (1.0, 2.0)
    assert (of("contacts-D1500-width"), of("contacts-D1500-sigma")) == ((both[0], 2.0), (1.0, both[1]))
    # d 17, mu 1: sigma = h sqrt(2 / d), and a spread moves the exponent by one.
    assert 17 * both[1] ** 2 / (2 * both[0] ** 2) == pytest.approx(1.0)
    x0 = nominal(problem(config("contacts-D1500")).task)
    assert both[0] == 0.5 * float(np.sqrt(((1.0 - x0) ** 2).sum())), "as when the experiments were made"
    assert replace(config("contacts-D1500-fitted"), policy_config=config("contacts-D1500").policy_config) == replace(
        config("contacts-D1500"), algorithm_config=config("contacts-D1500-fitted").algorithm_config
    )


def test_a_set_up_is_its_preset_with_what_is_named_changed():
    changed = setup("thesis", features=7, pairs=3, state="tactile", generations=9)
    assert (changed.policy_config.features, changed.algorithm_config.pairs) == (7, 3)
    assert (changed.task_config.state, changed.generations) == ("tactile", 9)
    assert replace(changed.algorithm_config, pairs=15) == configure(preset="thesis").algorithm_config
    with pytest.raises(ConfigError, match="unknown setting fetures"):
        setup("thesis", fetures=7)


def test_trials_differ_in_their_seed_and_may_be_cut_but_not_stretched():
    run = RunConfig(generations=20)
    assert trial(run, 3) == replace(run, seed=3)
    assert trial(run, 0, 5).generations == 5
    assert trial(run, 0, 50).generations == 20


def test_nothing_is_said_of_a_set_up_without_runs(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import draw

    experiment = EXPERIMENTS["fig-4.5"]
    nothing = made(np.full((3, 9), np.nan), states=("missing",) * 3, succeeded=np.zeros(3, bool))
    configs = {label: config(name) for label, name in experiment.curves.items()}
    data = Data({"N 50": nothing, "N 15": made(rising(4, -1, 9, 3))}, {}, configs)
    assert judge(experiment, data) == []
    assert verdict([]) == "open"
    said = draw(experiment, data, tmp_path)[1].read_text()
    assert "N 50: trial 0 missing" in " ".join(re.sub("<[^>]*>", " ", said).split())


def test_the_features_that_the_thesis_recommends():
    """Plage 2016, table 3.2, up to its rounding; 62 numbers where it says 63, and 594 features where it says 560."""
    assert [features_for(8, e) for e in (0.1, 0.2, 0.3)] == [1600, 280, 93]
    assert [features_for(17, e) for e in (0.1, 0.2, 0.3)] == [3400, 594, 198]
    assert [features_for(54, e) for e in (0.1, 0.2, 0.3)] == [10800, 1887, 627]
    assert features_for(63, 0.1) == 12600


# ---------------------------------------------------------------- series


def folder_with(path: Path, generations: int, state: str = "finished") -> RunFolder:
    """A run's folder with the files of a finished run."""
    run = RunFolder.create(path, RunConfig(generations=9))
    for g in range(1, generations + 1):
        told = stats(g, return_mean=-g / 7, mean_policy_success=g > 3)
        run.append(told, np.arange(8.0) * g, np.arange(8.0) / g, 9)
    run.write_summary({
        "state": state, "mean_policy_success": True, "robust_success_rate": 0.9, "mean_policy_return": -0.25,
        "parameters_sha256": "ab", "seconds": 3.0,
    })  # fmt: skip
    return run


def test_a_series_is_what_the_runs_recorded_and_survives_its_file(tmp_path):
    runs = [folder_with(tmp_path / "a", 9), folder_with(tmp_path / "b", 4, "diverged"), RunFolder(tmp_path / "none")]
    read = series.read(runs, RunConfig(generations=9))
    series.save(tmp_path / "s.npz", read)
    for s in (read, series.load(tmp_path / "s.npz")):
        assert s.states == ("finished", "diverged", "missing")
        assert s.failures() == ["trial 1 diverged", "trial 2 missing"]
        np.testing.assert_allclose(s.columns["return_mean"][0], -np.arange(1, 10) / 7, rtol=1e-6)
        assert np.isnan(s.columns["return_mean"][1, 4:]).all()
        assert np.isnan(s.columns["return_mean"][2]).all()
        assert s.columns["mu_2"][0].tolist() == [1.0 * g for g in range(1, 10)]
        np.testing.assert_allclose(s.columns["sigma_2"][1, :4], 1 / np.arange(1, 5), rtol=1e-6)
        assert s.learnt.tolist() == [True, True, False]
        assert s.since[0] == 4
        assert s.hashes == ("ab", "ab", "")
        assert s.rollouts == 30  # of its first line


def test_what_is_no_series_is_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match="cannot read"):
        series.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(ConfigError, match="cannot read"):
        series.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ConfigError, match="not a series"):
        series.load(tmp_path / "other.npz")


def test_since_when_a_policy_succeeds_to_the_end():
    success = np.array([[0, 1, 0, 1, 1], [1, 1, 1, 1, 1], [1, 1, 1, 1, 0], [0, 0, 0, 0, 1]])
    since = made(np.zeros((4, 5)), success).since
    np.testing.assert_array_equal(since, [4, 1, np.nan, 5])


# ---------------------------------------------------------------- findings


def test_a_verdict():
    yes, no, open_, untestable = (Finding("", holds, "") for holds in (True, False, UNDECIDED, UNTESTABLE))
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
    # As large or larger is the sum of the four high ones with any of -4.8, -4.9 and -5.0 (which is there twice).
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
    assert statistics.above(np.append(high, np.nan), low) == (answer, p), "a missing trial counts for nothing"


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng, inside = np.random.default_rng(5), 0
    for _ in range(100):
        low, high = statistics.difference(rng.normal(1.0, 1.0, 30), rng.normal(0.0, 1.0, 30))
        inside += low <= 1.0 <= high
    assert 88 <= inside <= 99
    assert statistics.share(0, 5) == pytest.approx((0.0, 1.0 - 0.025**0.2))
    assert statistics.share(5, 5) == pytest.approx((0.025**0.2, 1.0))


def test_set_ups_that_never_learn_are_not_compared():
    low, lower = (np.full((5, 150), level) + 0.01 * np.arange(5)[:, None] for level in (-5.27, -5.29))
    for found in (claims.pairs_per_generation, claims.rollouts_count):
        shown = data(made(low, robust=np.zeros(5)), made(lower, robust=np.zeros(5)))
        assert set(holds(found(shown))) == {UNTESTABLE}
        assert verdict(found(shown)) == "cannot be tested"
    learnt = made(rising(20, -1), success=np.ones((5, 150)))
    third = claims.states(data(learnt, made(low), made(lower)))[2]
    assert third.holds == UNTESTABLE, "contacts and touch both fail, and the least bit decides nothing"


def test_noise_does_not_make_two_set_ups_equal():
    rng = np.random.default_rng(3)
    for spread, holds in ((2.0, UNDECIDED), (0.1, True)):
        trials = -3.0 + rng.normal(0.0, spread, (2, 5, 1)) + np.zeros((2, 5, 150))
        assert claims.rollouts_count(data(*(made(own, np.ones((5, 150))) for own in trials)))[1].holds == holds


def test_an_experiment_has_its_own_number_of_trials(tmp_path):
    folder = ExperimentFolder.prepare(tmp_path / "e", ["fig-4.3", "fig-4.4"], None, None)
    assert (folder.count("joints-D300-30"), folder.count("joints-D1500-30"), folder.count("joints-D1500")) == (
        30,
        30,
        5,
    )
    assert len(folder.runs) == 3 * 30 + 3 * 5
    assert ExperimentFolder.open(folder.path) == folder
    with pytest.raises(ConfigError, match="has 30 trials: give as many or more"):
        ExperimentFolder.prepare(folder.path, ["fig-4.3", "fig-4.4"], 5, None)


def rising(at: int, to: float, length: int = 150, trials: int = 5) -> np.ndarray:
    """Returns that go from -100 to another value at a generation."""
    return np.tile(np.where(np.arange(1, length + 1) < at, -100.0, to), (trials, 1))


def data(*shown: Series, **measured: np.ndarray) -> Data:
    labels = [chr(97 + i) for i in range(len(shown))]
    return Data(dict(zip(labels, shown, strict=True)), measured, dict.fromkeys(labels, RunConfig()))


def holds(found: list[Finding]) -> list[bool]:
    return [finding.holds for finding in found]


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
    few, some, many = made(rising(151, 0)), made(rising(90, -5), learnt), made(rising(40, -1), learnt)
    for shown, expected in (((few, some, many), True), ((many, some, few), False)):
        found = holds(claims.features(data(*shown)))
        assert found[1] is expected
        assert found[2] is expected


def test_scaled_returns_are_compared_after_division():
    plain = made(rising(15, -1.5), hashes=tuple("abcde"))
    assert all(holds(claims.scale_free(data(plain, plain, made(100 * rising(15, -1.5))))))
    other = made(100 * rising(16, -1.5), hashes=tuple("abcdf"))
    assert holds(claims.scale_free(data(plain, other, other))) == [False, False, True]


def test_fewer_pairs_learn_sooner_over_rollouts():
    learnt = np.ones((5, 150))
    many, few = made(rising(50, -1), learnt, rollouts=100), made(rising(40, -1), learnt, rollouts=30)
    assert holds(claims.rollouts_count(data(many, few)))[0] is True
    slow = made(rising(149, -1), learnt, rollouts=30)
    assert holds(claims.rollouts_count(data(made(rising(5, -1), learnt, rollouts=100), slow))) == [False, False]


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


# ---------------------------------------------------------------- folders


def test_a_folder_is_one_experiments(tmp_path):
    out = tmp_path / "out"
    ExperimentFolder.prepare(out, ["fig-4.3"], 2, None)
    assert ExperimentFolder.open(out).setups == ("joints-D300-30", "joints-D1500-30", "joints-D8000-30")
    assert len(todo(ExperimentFolder.prepare(out, ["fig-4.3"], 3, None).runs)) == 9
    with pytest.raises(ConfigError, match=r"holds fig-4\.3: give a different --out"):
        ExperimentFolder.prepare(out, ["fig-4.5"], 3, None)
    with pytest.raises(ConfigError, match="started with all generations"):
        ExperimentFolder.prepare(out, ["fig-4.3"], 3, 5)
    with pytest.raises(ConfigError, match="has 3 trials"):
        ExperimentFolder.prepare(out, ["fig-4.3"], 2, None)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write to"):
        ExperimentFolder.prepare(tmp_path / "file", ["fig-4.3"], 2, None)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.tex").write_text("mine")
    with pytest.raises(ConfigError, match="holds something else"):
        ExperimentFolder.prepare(tmp_path / "taken", ["fig-4.3"], 2, None)


def test_data_whose_runs_are_gone_is_not_overwritten(tmp_path):
    """If all runs of a set-up are gone, its data stays; if some are gone, nothing is done."""
    folder = ExperimentFolder.prepare(tmp_path / "out", ["text-8000"], 2, 9)
    configs = [folder.config("joints-D8000", number) for number in range(2)]
    for number in range(2):
        run = folder_with(folder.run("joints-D8000", number).path, 9)
        run.write_config(configs[number])
    folder.gather()
    file = folder.path / "data" / "joints-D8000.npz"
    before = file.read_bytes()
    shutil.rmtree(folder.run("joints-D8000", 0).path)
    with pytest.raises(ConfigError, match="joints-D8000-s0, which is gone"):
        folder.gather()
    with pytest.raises(ConfigError, match="is gone"):
        ExperimentFolder.prepare(tmp_path / "out", ["text-8000"], 2, 9)
    shutil.rmtree(folder.run("joints-D8000", 1).path)
    folder.gather()
    assert file.read_bytes() == before
    with pytest.raises(ConfigError, match="is gone"):
        ExperimentFolder.prepare(tmp_path / "out", ["text-8000"], 2, 9)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 1}', '{"version": 1, "experiments": ["none"]}',
                                  '{"version": 1, "experiments": ["fig-4.3"], "trials": "2"}'])  # fmt: skip
def test_a_broken_folder_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "experiment.json").write_text(text)
    with pytest.raises(ConfigError) as said:
        ExperimentFolder.open(tmp_path)
    assert "\n" not in str(said.value)


def test_an_unknown_experiment_names_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown experiment 'fig-9'; known are fig-4\.1, fig-4\.2"):
        find("fig-9")


def test_runs_that_are_over_are_not_repeated_and_failed_ones_are(tmp_path):
    for state, expected in (("finished", True), ("diverged", True), ("failed", False), ("interrupted", False)):
        path = folder_with(tmp_path / state, 3, state).path
        assert (not todo({path: configure(generations=3)})) is expected
    assert todo({tmp_path / "none": configure()})


# ---------------------------------------------------------------- figures


@pytest.mark.parametrize("name", ["fig-4.1", "fig-4.2", "fig-4.6", "objects", "friction", "chain", "table-3.2"])
def test_every_kind_of_figure_can_be_drawn_and_says_what_failed(tmp_path, name):
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import draw

    experiment = EXPERIMENTS[name]
    count, rng = len(experiment.curves), np.random.default_rng(0)
    shown = [made(-10 * rng.random((5, 30)), rng.random((5, 30)) > 0.5) for _ in range(count)]
    if shown:
        broken = {k: np.where(np.arange(30) < 12, v, np.nan) for k, v in shown[0].columns.items()}
        shown[0] = replace(shown[0], columns=broken, states=("finished",) * 3 + ("diverged", "missing"))
    known = dict(zip(experiment.curves, shown, strict=True))
    configs = {label: config(name) for label, name in experiment.curves.items()}
    paths = draw(experiment, Data(known, measurements(experiment, count), configs), tmp_path)
    assert all(path.stat().st_size > 5000 for path in paths)
    svg = " ".join(re.sub("<[^>]*>", " ", paths[1].read_text()).split())
    assert experiment.title in svg
    assert not shown or "trial 3 diverged" in svg
    if name != "fig-4.1":
        return
    again = paths[1].read_bytes()
    assert draw(experiment, Data(known, measurements(experiment, count), configs), tmp_path)[1].read_bytes() == again


def test_a_figure_keeps_the_numbers_that_are_read() -> None:
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import shortened

    svg = '<path d="M 12.345678 -0.123456 L 7.5 8" transform="scale(0.015625)"/><text x="100.987654">1.12345</text>'
    assert (
        shortened(svg)
        == '<path d="M 12.35 -0.123456 L 7.5 8" transform="scale(0.015625)"/><text x="100.99">1.12345</text>'
    )


def measurements(experiment: Experiment, count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    figure = experiment.figure
    if isinstance(figure, Transfer):
        return {"transfer": rng.random((count, 5, len(figure.objects)))}
    if isinstance(figure, Friction):
        return {"success": rng.random((count, 5, len(figure.factors))), "factors": np.array(figure.factors)}
    if isinstance(figure, Chain):
        return {"reached": rng.random((5, 9)), "acting": np.arange(20) % 2, "force": rng.random((20, 3))}
    if isinstance(figure, KernelError):
        sizes = np.array(claims.SIZES)
        return {"error": rng.random((4, len(figure.features))), "sizes": sizes, "features": np.array(figure.features)}
    assert isinstance(figure, Curves)
    return {"action": 1 + rng.random((count, 5, 30)), "saturated": rng.random((count, 5, 30))}


@pytest.mark.parametrize("name", [name for name, e in EXPERIMENTS.items() if e.find])
def test_every_claim_is_held_against_any_data(name):
    experiment = EXPERIMENTS[name]
    count = len(experiment.curves)
    rng = np.random.default_rng(2)
    shown = [made(-10 * rng.random((5, 30)), rng.random((5, 30)) > 0.5) for _ in range(count)]
    known = dict(zip(experiment.curves, shown, strict=True))
    assert experiment.find
    shown_data = Data(known, measurements(experiment, count), dict.fromkeys(known, RunConfig()))
    found = judge(experiment, shown_data)
    assert found
    if known:  # one that ended after three generations is judged as well, one that is missing not at all
        label, first = next(iter(known.items()))
        short = {
            k: np.where((np.arange(5) == 4)[:, None] & (np.arange(30) > 2), np.nan, v) for k, v in first.columns.items()
        }
        known[label] = replace(first, columns=short, states=("finished",) * 4 + ("diverged",))
        assert judge(experiment, shown_data)
        known[label] = replace(first, states=("finished",) * 4 + ("missing",))
        assert judge(experiment, shown_data) == []
    assert all(finding.holds in (True, False, UNDECIDED, UNTESTABLE) for finding in found)
    assert all(finding.part and finding.numbers for finding in found)
