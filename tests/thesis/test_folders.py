"""Series of runs, and folders of experiments."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from made import stats
from trials import made

from benchmarks.thesis import series
from benchmarks.thesis.folder import ExperimentFolder, find
from farm.errors import ConfigError
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.tools.sweep.runs import todo


def folder_with(path: Path, generations: int, state: str = "finished") -> RunFolder:
    """A run's folder with the files of a finished run."""
    run = RunFolder.create(path, RunConfig(generations=9))
    for g in range(1, generations + 1):
        progress = stats(g, return_mean=-g / 7, mean_policy_success=g > 3)
        run.append(progress, np.arange(8.0) * g, np.arange(8.0) / g, 9)
    run.write_summary(
        {
            "state": state,
            "mean_policy_success": True,
            "robust_success_rate": 0.9,
            "mean_policy_return": -0.25,
            "parameters_sha256": "ab",
            "seconds": 3.0,
        }
    )
    return run


def test_a_series_is_what_the_runs_recorded_and_survives_its_file(tmp_path):
    runs = [
        folder_with(tmp_path / "a", 9),
        folder_with(tmp_path / "b", 4, "diverged"),
        RunFolder(tmp_path / "none"),
    ]
    trials = series.read(runs, RunConfig(generations=9))
    series.save(tmp_path / "s.npz", trials)
    for s in (trials, series.load(tmp_path / "s.npz")):
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


def test_a_folder_is_one_experiments(tmp_path):
    out = tmp_path / "out"
    ExperimentFolder.prepare(out, ["fig-4.3"], 2, None)
    assert ExperimentFolder.open(out).setups == (
        "joints-D300-30",
        "joints-D1500-30",
        "joints-D8000-30",
    )
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


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"version": 1}',
        '{"version": 1, "experiments": ["none"]}',
        '{"version": 1, "experiments": ["fig-4.3"], "trials": "2"}',
    ],
)
def test_a_broken_folder_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "experiment.json").write_text(text)
    with pytest.raises(ConfigError) as error:
        ExperimentFolder.open(tmp_path)
    assert "\n" not in str(error.value)


def test_an_unknown_experiment_names_the_known_ones():
    with pytest.raises(
        ConfigError, match=r"unknown experiment 'fig-9'; known are fig-4\.1, fig-4\.2"
    ):
        find("fig-9")


def test_runs_that_are_over_are_not_repeated_and_failed_ones_are(tmp_path):
    for state, expected in (
        ("finished", True),
        ("diverged", True),
        ("failed", False),
        ("interrupted", False),
    ):
        path = folder_with(tmp_path / state, 3, state).path
        assert (not todo({path: configure(generations=3)})) is expected
    assert todo({tmp_path / "none": configure()})
