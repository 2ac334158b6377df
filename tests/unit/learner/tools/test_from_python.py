"""Public functions that do what a command does: the same numbers, files and messages."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, learnt

import farm
from farm.__main__ import main
from learner.run.config import configure
from learner.tools.sweep import command
from learner.tools.sweep import sweep as sweeps
from learner.tools.sweep.grid import Setting


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A learnt run of a task in a file."""
    folder = tmp_path_factory.mktemp("learnt")
    (folder / "pole.py").write_text(POLE)
    learnt(configure(f"{folder / 'pole.py'}:Pole"), folder / "r")
    return folder / "r"


def said(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert main([str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_an_evaluation_is_what_the_command_prints(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = farm.evaluate(run, rollouts=7, seed=3, last=True)
    words = ("--rollouts", 7, "-s", 3, "--last", "--json")
    assert figures == json.loads(said(capsys, "evaluate", run, *words))
    assert farm.evaluate(str(run)) == json.loads(said(capsys, "evaluate", run, "--json"))
    assert figures["perturbed"]["rollouts"] == 7


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"rollouts": 0}, "rollouts is 0; expected 1 to 1000000"),
        ({"seed": -1}, "seed is -1; expected 0 to 4294967295"),
        ({"average": 0}, "average is 0; expected 1 to "),
        ({"rollouts": 1.5}, "rollouts is 1.5; expected int"),
        ({"allow_file": "nowhere.py"}, "--allow-file nowhere.py: there is no such file"),
    ],
)
def test_an_evaluation_that_makes_no_sense(run: Path, changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(farm.ConfigError, match=f"^{reason}"):
        farm.evaluate(run, **changed)


def test_an_export_is_the_commands_file(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = tmp_path / "ours.npz", tmp_path / "theirs.npz"
    policy = farm.export(run, ours, generation=1)
    words = said(capsys, "export", run, theirs, "--generation", 1)
    assert words.startswith("mean policy after generation 1 written to ")
    assert policy.generation == 1
    with np.load(ours) as one, np.load(theirs) as other:
        assert sorted(one) == sorted(other)
        assert all((one[name] == other[name]).all() for name in one)
        assert (one["mu"] == policy.mu).all()


def test_an_export_to_a_file_of_another_kind_writes_nothing(run: Path, tmp_path: Path) -> None:
    with pytest.raises(farm.ConfigError, match=r"policy.txt: expected a name that ends in .npz"):
        farm.export(run, tmp_path / "policy.txt")
    assert not list(tmp_path.iterdir())


def test_a_check_says_each_line_at_once_and_returns_all(run: Path) -> None:
    lines: list[str] = []
    task = f"{run.parent / 'pole.py'}:Pole"
    found = farm.check(task, policy="linear", steps=3, said=lines.append)
    assert found == lines
    assert "same bits together, in another order, one by one, and in another process" in found
    assert any(line.startswith("3 control steps") for line in found)
    assert any(line.startswith("policy linear with") for line in found)
    assert not any("picture" in line or line.startswith("the start") for line in found)
    config = configure(task, policy="linear")
    assert found[:5] == farm.check(config, steps=3)[:5], "a run of the task says which task it is"


def test_a_check_that_cannot_begin(tmp_path: Path) -> None:
    with pytest.raises(farm.ConfigError, match="unknown task 'finger-giat'"):
        farm.check("finger-giat")
    with pytest.raises(farm.ConfigError, match=r"x.jpg: expected a name that ends in .png"):
        farm.check("finger-gait", picture=tmp_path / "x.jpg")


def settings_of(monkeypatch: pytest.MonkeyPatch, folder: Path) -> list[list[Setting]]:
    """The settings of sweeps, none of which learns."""
    seen: list[list[Setting]] = []

    def keep(sweep: Any, *_: object) -> tuple[bool, list[Any]]:
        seen.append(list(sweep.settings))
        return True, []

    for module in (command, sweeps):
        monkeypatch.setattr(module, "learnt", keep)
    monkeypatch.setattr(command, "_print", lambda *_: None)
    monkeypatch.setattr(command, "_draw", lambda *_: None)
    monkeypatch.chdir(folder)
    return seen


@pytest.mark.slow
def test_a_sweep_is_that_of_the_command_and_continues_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = settings_of(monkeypatch, tmp_path)
    words = ("--vary", "pairs=3,4", "--vary", "clip=true,false", "--seeds", "0-1", "-o", "both")
    assert main(["sweep", *words, "--policy", "linear", "-w", "1"]) == 0
    config = configure("finger-gait", policy="linear", seed=9)
    vary = {"pairs": [3, 4], "clip": [True, False]}
    farm.sweep(config, "both", vary=vary, seeds=range(3), workers=1)
    theirs, ours = seen
    assert [each.config for each in ours] == [each.config for each in theirs]
    assert json.loads((tmp_path / "both/sweep.json").read_text())["seeds"] == [0, 1, 2]


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"vary": {"pears": [1]}}, "vary pears=1: unknown setting pears"),
        ({"vary": {"pairs": [0]}}, "vary pairs=0: pgpe: pairs is 0; expected 1 or more"),
        ({"vary": {"seed": [1]}}, "vary seed: give seeds"),
        ({"vary": {"pairs": [2, 2]}}, "--vary: pairs 2 and pairs 2 are the same configuration"),
        ({"vary": {"task_config": [{}]}}, "vary task_config=.*: unknown setting task_config"),
        ({"vary": ["pairs"]}, "vary is .*; expected values by setting"),
        ({"vary": {"pairs": []}}, r"vary pairs: \[\]; expected a list of one value or more"),
        ({"vary": {"pairs": 2}}, "vary pairs: 2; expected a list of one value or more"),
        ({"vary": {"policy": "linear"}}, "vary policy: 'linear'; expected a list"),
        ({"seeds": ()}, r"seeds: \(\); expected a list of one value or more"),
        ({"seeds": 3}, "seeds: 3; expected a list of one value or more"),
        ({"seeds": (1, 1)}, "--seeds '1,1': a seed is given twice"),
        ({"workers": 0}, "--workers 0 without --connect"),
    ],
)
def test_a_sweep_that_makes_no_sense_begins_nothing(
    tmp_path: Path, changed: dict[str, Any], reason: str
) -> None:
    with pytest.raises(farm.ConfigError, match=f"^{reason}"):
        farm.sweep(configure("finger-gait"), tmp_path / "none", **changed)
    assert not list(tmp_path.iterdir())


class Own(farm.Task):
    """A class, where its name is expected."""


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: farm.configure(Own), "task <class .*Own'>; expected its name, or FILE.py:CLASS"),
        (lambda: farm.check(Own), "task <class .*Own'>; expected its name"),
        (lambda: farm.Farm(Own), "task <class .*Own'>; expected its name"),
        (lambda: farm.RunConfig(task=Own), "task <class .*Own'>; expected its name"),
        (lambda: farm.configure(task_config={"friction": 1.0}), "unknown setting task_config"),
        (
            lambda: farm.RunConfig(task_config={"friction": 1.0}),
            r"task_config is a dict; expected the .* of finger-gait: farm\.configure takes each",
        ),
        (
            lambda: next(farm.learn("finger-gait", "none")),
            r"config is 'finger-gait'; expected a farm\.RunConfig, as of farm\.configure",
        ),
        (lambda: farm.sweep("finger-gait", "none"), "config is 'finger-gait'; expected"),
        (lambda: farm.tune("finger-gait", "none", rollouts=9), "config is 'finger-gait'; expected"),
        (
            lambda: farm.tune(configure(), "none", rollouts=9, entries=[{"policy": "mlp"}]),
            r"entries is \[.*; expected settings by the entry's name",
        ),
        (
            lambda: next(farm.learn(configure(), "none", log="tensorbord")),
            "unknown logger 'tensorbord'",
        ),
        (lambda: farm.configure(friction=10**400), "friction is inf; expected a finite number"),
        (lambda: farm.load(None), "a run's folder is None; expected a path"),
        (lambda: farm.evaluate("r", allow_file=3), "allow_file is 3; expected a file, or several"),
        (lambda: farm.load("r", 2, last=True), "generation and last exclude each other"),
        (
            lambda: next(farm.learn(farm.configure(), "r", log=3)),
            "log is 3; expected names of loggers",
        ),
        (
            lambda: farm.tune(farm.configure(), "t", rollouts=900, entries={"a": 3}),
            "entry 'a': 3; expected settings by name",
        ),
    ],
)
def test_values_of_other_kinds_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Any, reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(farm.ConfigError, match=reason) as error:
        call()
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_generation_is_a_number(run: Path) -> None:
    with pytest.raises(farm.ConfigError, match="generation is '2'; expected a whole number"):
        farm.load(run, generation="2")  # type: ignore[arg-type]


def test_a_data_set_is_no_file(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["dataset", str(run), "--out", str(tmp_path / "notes.txt")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "notes.txt").read_text() == "mine"
