"""`farm runs`: one run with damaged files costs its own row, not the table."""

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import checkpoint, stats

from farm.__main__ import main
from farm.errors import Interrupted
from learner.run import checkpoint as checkpoints
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.tools.runs.command import LEGEND

GOOD: dict[str, Any] = {
    "run": "good",
    "seed": 1,
    "generations": 3,
    "rollouts": 90,
    "mean_policy_return": 1.5,
    "mean_policy_success": True,
    "robust_success_rate": 0.25,
    "parameters_sha256": "0123456789abcdef",
    "state": "finished",
    "seconds": 1.0,
    "robust_score": 1.25,
}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name in ("a", "good", "z"):
        RunFolder.create(tmp_path / name, RunConfig()).write_summary(GOOD)
    return tmp_path


def damage(runs: Path, text: str) -> None:
    for name in ("a", "z"):
        (runs / name / "summary.json").write_text(text)


def table(runs: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    capsys.readouterr()
    assert main(["runs", str(runs), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) == 3
    assert main(["runs", str(runs)]) == 0
    _, first, good, last, *legend = capsys.readouterr().out.splitlines()
    assert legend == list(LEGEND)
    return [first, good, last]


@pytest.mark.parametrize("name", GOOD)
def test_one_value_of_another_type(
    runs: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for value in ([], {}, "x", True, 10**400, -(10**30)):
        if type(value) is not type(GOOD[name]):
            assert_costs_its_own_row(runs, name, value, capsys)


def assert_costs_its_own_row(
    runs: Path, name: str, value: object, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(runs, json.dumps({**GOOD, name: value}))
    first, good, last = table(runs, capsys)
    assert good.split() == ["good", "finished", "3", "1.500", "1.25", "yes", "25%", "01234567"]
    assert first.split()[:5] == ["a", "summary.json", "is", "damaged", "0"]
    assert last.split()[:5] == ["z", "summary.json", "is", "damaged", "0"]


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"run"', "\0"])
def test_no_summary_at_all(runs: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    damage(runs, text)
    assert "is damaged" in table(runs, capsys)[0]


@pytest.mark.parametrize(
    ("file", "state"),
    [("config.json", "config.json is damaged"), ("checkpoint", "checkpoint cannot be read")],
)
def test_a_run_that_cannot_be_opened_is_not_finished(
    runs: Path, file: str, state: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (runs / "a" / file).write_text("{")
    assert table(runs, capsys)[0].startswith(f"a     {state}")


@pytest.mark.parametrize("missing", GOOD)
def test_a_value_is_missing(runs: Path, missing: str, capsys: pytest.CaptureFixture[str]) -> None:
    damage(runs, json.dumps({name: value for name, value in GOOD.items() if name != missing}))
    assert len(table(runs, capsys)) == 3


def test_an_interrupted_run_shows_the_return_of_its_last_generation(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = {
        name: None for name in ("mean_policy_return", "mean_policy_success", "robust_success_rate")
    }
    last = stats(3)
    RunFolder(runs / "a").append(last, np.zeros(2), np.ones(2), 3)
    damage(runs, json.dumps({**GOOD, **cut, "run": "cut", "state": "interrupted"}))
    words = table(runs, capsys)[0].split()
    assert words == ["a", "interrupted", "3", "-4.000", "1.25", "not", "yet", "01234567"]


def test_names_are_shown_as_they_are(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage(runs, json.dumps({**GOOD, "state": "\u202e"}))
    (runs / "a").rename(runs / "[red]a\x1b[2J")
    assert table(runs, capsys)[0].split()[:2] == ["[red]a\\x1b[2J", "\\u202e"]


def test_csv_has_a_column_for_each_name_in_a_summary(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (runs / "a" / "summary.json").unlink()
    (runs / "z" / "summary.json").write_text(json.dumps({**GOOD, "steps": 7}))
    (runs / "z").rename(runs / 'z, an "old" one')
    assert main(["runs", str(runs), "--csv"]) == 0
    first, good, last = csv.DictReader(capsys.readouterr().out.splitlines())
    assert (first["state"], first["mean_policy_return"], first["steps"]) == (
        "running or killed",
        "",
        "",
    )
    assert {name: good[name] for name in GOOD} == {name: str(value) for name, value in GOOD.items()}
    assert (last["run"], last["steps"]) == ('z, an "old" one', "7"), "a copy has its folder's name"
    assert main(["runs", str(runs), "--csv", "--json"]) == 2
    assert "--json, --csv and --serve exclude each other" in capsys.readouterr().err


def test_csv_has_tables_as_json(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage(runs, json.dumps({**GOOD, "checks": {"host": 3}}))
    assert main(["runs", str(runs), "--csv"]) == 0
    first, *_ = csv.DictReader(capsys.readouterr().out.splitlines())
    assert json.loads(first["checks"]) == {"host": 3}


def test_a_folder_without_runs_and_a_run(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["runs", str(runs / "good")]) == 2
    assert f"{runs / 'good'} is a run: give the folder that holds it" in capsys.readouterr().err
    (tmp_path / "none").mkdir()
    assert main(["runs", str(tmp_path / "none")]) == 0
    assert capsys.readouterr().out == f"there are no runs in {tmp_path / 'none'}\n"


def test_no_number_is_cut_on_a_narrow_terminal(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # for rich, standard output is a terminal
    monkeypatch.setenv("NO_COLOR", "1")
    assert main(["runs", str(runs)]) == 0
    text = capsys.readouterr().out
    for word in ("good", "finished", "1.500", "1.25", "25%", "01234567"):
        assert word in text


def test_a_run_that_was_cut_short_has_not_failed(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, state in (("a", "interrupted"), ("z", "finished")):
        damage(
            runs, json.dumps({**GOOD, "run": name, "mean_policy_success": False, "state": state})
        )
        words = table(runs, capsys)[0].split()
        assert ("not" in words, "no" in words) == (
            (True, False) if state == "interrupted" else (False, True)
        )


def test_a_copy_of_a_run_is_left_out_of_the_catalog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    viewing = pytest.importorskip("learner.recording.viewing")
    served: list[Path] = []

    @contextmanager
    def catalog(_: str, files: list[Path], __: int) -> Iterator[str]:
        served.extend(files)
        raise Interrupted("looked at")
        yield ""

    monkeypatch.setattr(viewing, "catalog", catalog)
    for name in ("a", "b", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}")
        (tmp_path / name / "run.rrd").touch()
    checkpoints.save(tmp_path / "a" / "checkpoint", checkpoint(run="first"))
    checkpoints.save(tmp_path / "b" / "checkpoint", checkpoint(run="first"))
    assert main(["runs", str(tmp_path), "--serve", "51234"]) == 130
    assert served == [tmp_path / "a" / "run.rrd", tmp_path / "other" / "run.rrd"]
    said = (
        f"{tmp_path / 'b'} is left out: it is a copy of {tmp_path / 'a'}, with the same"
        " recording's id"
    )
    assert said in capsys.readouterr().out
