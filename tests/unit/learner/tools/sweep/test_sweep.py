"""A sweep: varied settings, folders, error messages, and the table."""

import csv
import json

import numpy as np
import pytest
from made import stats

from farm.errors import ConfigError
from learner import plots
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.tools.sweep import command, figure, grid, outcomes
from learner.tools.sweep import runs as sweeps
from learner.tools.sweep.grid import Setting, Sweep
from learner.tools.sweep.runs import todo


def sweep_of(path, *sigmas, seeds=(0, 1), **common):
    values = [{"initial_sigma": sigma} for sigma in sigmas]
    settings = [
        Setting(v, configure(initial_sigma=float(v["initial_sigma"]), **common)) for v in values
    ]
    return Sweep(path, tuple(settings), seeds)


def ran(path, config, returns, state="finished", final=None, rollouts=30):
    """A run's folder with the files of a finished run."""
    folder = RunFolder.create(path, config)
    for g, value in enumerate(returns, start=1):
        folder.append(
            stats(g, rollouts=rollouts * g, mean_policy_return=value),
            np.zeros(2),
            np.ones(2),
            len(returns),
        )
    folder.write_summary(
        {
            "state": state,
            "mean_policy_return": final,
            "mean_policy_success": None if final is None else True,
            "robust_success_rate": None if final is None else 0.5,
            "robust_return": final,
            "parameters_sha256": "ab",
        }
    )
    return folder


# ---------------------------------------------------------------- what is asked for


def test_seeds_and_values_are_read_as_they_are_written():
    assert grid.parse_seeds("0-4") == (0, 1, 2, 3, 4)
    assert grid.parse_seeds("7,3, 9") == (7, 3, 9)
    assert grid.parse_seeds("1-2,5") == (1, 2, 5)
    vary = grid.parse_vary(["initial-sigma=0.05,0.1", "policy=direct, kernel"])
    assert vary == {"initial_sigma": ["0.05", "0.1"], "policy": ["direct", "kernel"]}
    combinations = grid.combinations(vary, 5)
    assert [tuple(each.values()) for each in combinations] == [
        ("0.05", "direct"),
        ("0.05", "kernel"),
        ("0.1", "direct"),
        ("0.1", "kernel"),
    ]
    assert grid.combinations({}, 5) == [{}]


@pytest.mark.parametrize(
    "text", ["", "a", "3-1", "1,1", "0-2,2", "-1", "4294967296", "0-4294967295", "1,,2", "1.5"]
)
def test_seeds_that_make_no_sense(text):
    with pytest.raises(ConfigError, match="--seeds") as error:
        grid.parse_seeds(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "words",
    [
        ["a"],
        ["a="],
        ["=1"],
        ["a=1,,2"],
        ["a=1", "a=2"],
        ["a-b=1", "a_b=2"],
        ["a=1,1"],
        ["seed=1,2"],
    ],
)
def test_values_that_make_no_sense(words):
    with pytest.raises(ConfigError, match="--vary"):
        grid.parse_vary(words)


def test_too_many_runs():
    with pytest.raises(ConfigError, match="10201 settings x 1 seeds are 10201 runs"):
        grid.combinations({"a": [str(i) for i in range(101)], "b": [str(i) for i in range(101)]}, 1)


def test_runs_are_named_by_what_is_varied_and_begin_seed_by_seed(tmp_path):
    runs = sweep_of(tmp_path, "0.1", "0.2").runs
    assert [path.name for path in runs] == [
        f"initial_sigma-{v}-s{seed}" for seed in (0, 1) for v in ("0.1", "0.2")
    ]
    assert [(c.seed, c.algorithm_config.initial_sigma) for c in runs.values()] == [
        (0, 0.1),
        (0, 0.2),
        (1, 0.1),
        (1, 0.2),
    ]
    assert [path.name for path in Sweep(tmp_path, (Setting({}, RunConfig()),), (3,)).runs] == ["s3"]


def test_values_that_make_no_name_are_numbered(tmp_path):
    values = (
        {"task": "gym:A/B-v0"},
        {"task": "gym/A:B-v0"},
        {"task": "my/tasks.py:B-v0"},
        {"object": "x" * 95},
    )
    sweep = Sweep(tmp_path, tuple(Setting(v, RunConfig()) for v in values), (0,))
    assert sweep.names == ("task-B-v0", "task-A-B-v0", "task-tasks.py-B-v0", "setting-3")
    twice = Sweep(
        tmp_path,
        tuple(Setting(v, RunConfig()) for v in ({"object": "a/b.xml"}, {"object": "c/b.xml"})),
        (0,),
    )
    assert twice.names == ("setting-0", "setting-1")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--vary", "foo=1,2"), "--vary foo=1: no such setting; known are task, policy, algorithm"),
        (("--vary", "out=a,b"), "no such setting"),
        (("--vary", "initial_sigma=a,b"), "--initial-sigma 'a': expected a number"),
        (("--vary", "initial_sigma=-1,1"), "initial-sigma is -1.0; expected a positive number"),
        (
            ("--vary", "initial_sigma=0.1,0.10"),
            "initial_sigma 0.1 and initial_sigma 0.10 are the same configuration",
        ),
        (("--vary", "policy=direct,nope"), "unknown policy 'nope'"),
        (("--vary", "policy=direct,kernel", "--features", "9"), "unexpected: --features"),
        (("--vary", "object=bar,nothing"), "object nothing: unknown object 'nothing'"),
        (("--seed", "4"), "--seed is for one run: give --seeds"),
        (("--seeds", "x"), "--seeds 'x' is not of the form"),
        (("--nope", "3"), "unexpected: --nope, 3"),
        (("--workers", "0"), "there would be no workers"),
        (("--parallel", "0"), "parallel is 0; expected 1 to 256"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_begun(tmp_path, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as error:
        command.main(words)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_nothing_need_be_varied(tmp_path, monkeypatch):
    monkeypatch.setattr(sweeps, "run", lambda runs, *_: len(runs) == 5)
    monkeypatch.chdir(tmp_path)
    assert command.main([]) == 0


def test_a_setting_is_what_farm_run_would_take():
    words = (
        "--vary",
        "policy=direct,kernel",
        "--vary",
        "clip=true,false",
        "--pairs",
        "4",
        "--preset",
        "thesis",
    )
    setting = command._setting({"policy": "direct", "clip": "false"}, words)
    assert setting.config == configure(preset="thesis", policy="direct", clip=False, pairs=4)
    assert setting.label == "policy direct, clip false"


# ---------------------------------------------------------------- the folder


def test_a_folder_is_one_sweeps_and_seeds_may_be_added(tmp_path):
    out = tmp_path / "out"
    sweep_of(out, "0.1", "0.2").prepare()
    sweep_of(out, "0.1", "0.2", seeds=(0, 1, 2)).prepare()
    assert json.loads((out / "sweep.json").read_text())["seeds"] == [0, 1, 2]
    for other, reason in (
        (sweep_of(out, "0.1", "0.2"), "has seeds 2 as well"),
        (
            sweep_of(out, "0.1", seeds=(0, 1, 2)),
            "varies initial_sigma=0.1,0.2; here it is initial_sigma=0.1:",
        ),
        (
            sweep_of(out, "0.1", "0.2", seeds=(0, 1, 2), pairs=3),
            "was started with --pairs 5; here it is 3",
        ),
        (
            sweep_of(out, "0.1", "0.2", seeds=(0, 1, 2), generations=3),
            "was started with --generations 90; here it is 3",
        ),
    ):
        with pytest.raises(ConfigError, match="a different --out") as error:
            other.prepare()
        assert reason in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"version": 2}',
        '{"version": 1, "vary": 3}',
        '{"version": 1, "vary": {"initial_sigma": 3}, "seeds": [], "settings": []}',
        '{"version": 1, "vary": {"initial_sigma": ["0.1"]}, "seeds": [], "settings": 3}',
        '{"version": 1, "vary": {"initial_sigma": ["0.1"]}, "seeds": [], "settings": [3]}',
        '{"version": 1, "vary": {"initial_sigma": ["0.1"]}, "seeds": [], "settings": []}',
        "[" * 100_000,
    ],
    ids=range(10),
)
def test_a_broken_folder_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(ConfigError) as error:
        sweep_of(tmp_path, "0.1").prepare()
    assert "\n" not in str(error.value)
    assert "cannot write" not in str(error.value)  # the file is at fault, and not the disk


def test_other_things_are_not_written_into(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ConfigError, match="holds something else"):
        sweep_of(tmp_path, "0.1").prepare()
    with pytest.raises(ConfigError, match="cannot write to"):
        sweep_of(tmp_path / "thesis.tex", "0.1").prepare()


# ---------------------------------------------------------------- what came out


def test_the_table_tells_of_every_run_and_means_of_those_that_are_known(tmp_path):
    sweep = sweep_of(tmp_path, "0.1", "0.2")
    paths = list(sweep.runs)
    ran(paths[0], RunConfig(), [-5.0, -4.0], final=-3.0)
    ran(paths[2], RunConfig(seed=1), [-5.0, -3.0], final=-1.0)
    ran(paths[1], RunConfig(), [-5.0], state="diverged")
    assert todo(sweep.runs) == paths[3:]
    table = outcomes.rows(sweep)
    outcomes.write_csv(tmp_path / "table.csv", sweep, table)
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["initial_sigma", *outcomes.COLUMNS]
    assert [(r["initial_sigma"], r["seed"], r["state"]) for r in rows] == [
        ("0.1", "0", "finished"),
        ("0.1", "1", "finished"),
        ("0.2", "0", "diverged"),
        ("0.2", "1", "not begun"),
    ]
    assert (rows[0]["generations"], rows[0]["rollouts"], rows[0]["seconds"]) == ("2", "60", "4.0")
    assert (rows[0]["first_mean_policy_return"], rows[2]["mean_policy_return"]) == ("-5.0", "")
    parquet = pytest.importorskip("pyarrow.parquet")
    outcomes.write_parquet(tmp_path / "table.parquet", sweep, table)
    assert parquet.read_table(tmp_path / "table.parquet").to_pylist() == table, (
        "typed, and None where nothing is known"
    )
    assert outcomes.spread(table[:2], "mean_policy_return") == (-2.0, 1.0)
    assert outcomes.spread(table[2:], "mean_policy_return") is None


def test_the_printed_table_has_a_line_a_setting(tmp_path, capsys):
    sweep = sweep_of(tmp_path, "0.1", "0.2")
    ran(next(iter(sweep.runs)), RunConfig(), [-5.0, -4.0], final=-3.0)
    command._print(sweep, outcomes.rows(sweep))
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "initial_sigma runs untrained return robust success minutes"
    assert lines[1:3] == ["0.1 1 of 2 -5.000 ± 0.000 -3.000 ± 0.000 50% ± 0% 0.1", "0.2 0 of 2 0.0"]


def test_a_curve_is_over_the_rollouts_behind_each_mean_policy(tmp_path):
    sweep = sweep_of(tmp_path, "0.1", "0.2")
    paths = list(sweep.runs)
    ran(paths[0], RunConfig(), [-5.0, -4.0, -4.0], final=-3.0)
    ran(paths[2], RunConfig(), [-5.0, None], state="interrupted")
    (curve,) = outcomes.curves(sweep)
    assert curve.label == "initial_sigma 0.1"
    assert curve.rollouts.tolist() == [0, 30, 60, 90]
    np.testing.assert_array_equal(curve.returns, [[-5, -4, -4, -3], [-5, np.nan, np.nan, np.nan]])
    assert np.nanmean(curve.returns, axis=0).tolist() == [-5, -4, -4, -3]
    assert np.nanstd(curve.returns, axis=0).tolist() == [0, 0, 0, 0]


def test_a_curve_has_no_point_of_a_policy_from_before_the_last_update(tmp_path):
    sweep = sweep_of(tmp_path, "0.1")
    path = next(iter(sweep.runs))
    ran(path, RunConfig(), [-5.0, -4.0], final=-3.0)
    summary = RunFolder(path).read_summary()
    RunFolder(path).write_summary({**summary, "policy_generation": 1})
    (curve,) = outcomes.curves(sweep)
    assert curve.returns.tolist() == [[-5.0, -4.0]]


def test_runs_whose_generations_differ_in_size_share_their_rollouts():
    """As with `--interactions`."""
    short = np.array([0.0, 10.0, 20.0]), np.array([1.0, 2.0, 3.0])
    long = np.array([0.0, 20.0, 40.0, 80.0]), np.array([5.0, 6.0, 7.0, 8.0])
    curve = outcomes.joined("x", [short, long])
    assert curve.rollouts.tolist() == [0, 10, 20, 40, 80]
    np.testing.assert_array_equal(curve.returns, [[1, 2, 3, np.nan, np.nan], [5, 5, 6, 7, 8]])


def test_the_figure_names_every_setting_and_is_the_same_again(tmp_path):
    pytest.importorskip("matplotlib")
    curves = [
        outcomes.Curve(f"sigma {i}", np.arange(4.0), np.random.default_rng(i).random((3, 4)))
        for i in range(9)
    ]
    figure.draw(curves, tmp_path / "a.svg")
    figure.draw(curves, tmp_path / "b.svg")
    svg = (tmp_path / "a.svg").read_text()
    assert all(f"sigma {i}" in svg for i in range(9))
    assert svg == (tmp_path / "b.svg").read_text()


def test_without_matplotlib_one_line_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plots, "available", lambda: False)
    plots.announce()
    said = "there will be no figure: figures need matplotlib: pip install matplotlib\n"
    assert capsys.readouterr().out == said
    command._draw(sweep_of(tmp_path, "0.1"))
    assert capsys.readouterr().out == "", "it was said at the start"


def test_a_setting_that_is_called_as_a_result_has_a_column_of_its_own(tmp_path):
    values = [{"state": state, "pairs": "5"} for state in ("joints", "tactile")]
    settings = tuple(Setting(v, configure(state=v["state"], pairs=5)) for v in values)
    sweep = Sweep(tmp_path, settings, (0,))
    for i, setting in enumerate(settings):
        ran(sweep.folder(i, 0), setting.config, [1.0], final=2.0)
    table = outcomes.rows(sweep)
    assert [(row["setting_state"], row["state"]) for row in table] == [
        ("joints", "finished"),
        ("tactile", "finished"),
    ]
    outcomes.write_csv(tmp_path / "table.csv", sweep, table)
    with (tmp_path / "table.csv").open() as file:
        first, second = csv.DictReader(file)
    assert list(first)[:3] == ["setting_state", "pairs", "seed"]
    assert (second["setting_state"], second["state"]) == ("tactile", "finished")


def test_a_mean_policy_that_fails_is_shown_without_a_return(tmp_path, caplog):
    caplog.set_level("DEBUG")
    config = configure()
    path = tmp_path / "r"
    with command.Runs({path: config}, tmp_path) as bars:
        bars.progress("r", 1, 2, None)
        bars.progress("r", 2, 2, 1.5)
    sweeps.Logged().progress("r", 1, 2, None)
    assert caplog.messages[-1] == "r: generation 1 of 2, return -"
