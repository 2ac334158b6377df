"""A run's folder runs no code that its user has not named: somebody else may have made it."""

import json
import shutil
from pathlib import Path

import pytest
from alone import POLE, Alone

import farm
from farm.__main__ import main
from farm.errors import ConfigError
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner

EXECUTED = "\nfrom pathlib import Path\n(Path(__file__).parent / 'executed').touch()\n"
COMMANDS = (
    ("verify",),
    ("export", "--list"),
    ("evaluate", "--rollouts", "2"),
    ("replay",),
    ("run", "--resume"),
    ("run", "--generations", "1", "--init-from"),
    ("dataset", "--out", "data", "--episodes", "2"),
    ("chain",),
    ("compare",),
    ("play",),
)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run in the current folder, whose task's file has moved into it and says when its code
    runs.
    """
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "pole.py"
    file.write_text(POLE)
    config = configure(f"{file}:Pole", generations=2, pairs=2)
    problem, at = setup.start(config, "run")
    learner = Learner(problem, RunFolder.create(tmp_path / "run", config), at)
    for _ in learner.learn(Alone(problem)):  # type: ignore[arg-type]
        pass
    file.unlink()
    (tmp_path / "run" / "pole.py").write_text(POLE + EXECUTED)
    return tmp_path / "run"


def named(run: Path, name: str, part: str = "task") -> None:
    """Let the run name this class."""
    config = json.loads((run / "config.json").read_text())
    config[part]["name"] = name
    (run / "config.json").write_text(json.dumps(config))


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: words[0])
@pytest.mark.parametrize(
    "name", ["run/pole.py:Pole", "{run}/pole.py:Pole", "{run}/../run/pole.py:Pole"]
)
def test_no_command_runs_code_in_the_folder(
    run: Path, words: tuple[str, ...], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    named(run, name.format(run=run))
    shutil.copytree(run, "second")
    assert main([*words, "run", *(["second"] if words == ("compare",) else [])]) == 2
    reason = "own folder" if "{" in name else "a run writes absolute paths only"
    error = capsys.readouterr().err
    assert reason in error
    assert "--allow-file pole.py takes the class from a file that you trust" in error
    assert not (run / "executed").exists()


@pytest.mark.parametrize("part", ["task", "policy", "algorithm"])
def test_every_class_is_looked_at(run: Path, part: str) -> None:
    (run.parent / "pole.py").write_text(POLE)
    named(run, "run/pole.py:Pole", part)
    with pytest.raises(
        ConfigError, match=f"{part} is 'run/pole.py:Pole', and a run writes absolute paths only"
    ):
        RunFolder.open(run).read_config()
    assert not (run / "executed").exists()


def test_a_link_from_elsewhere_leads_into_the_folder(run: Path) -> None:
    link = run.parent / "elsewhere.py"
    link.symlink_to(run / "pole.py")
    named(run, f"{link}:Pole")
    with pytest.raises(ConfigError, match="own folder"):
        RunFolder.open(run).read_config()
    assert not (run / "executed").exists()


def test_a_checkpoint_names_no_code_either(run: Path) -> None:
    (run.parent / "pole.py").write_text(POLE)
    at = checkpoints.load(run / "checkpoint")
    at.config["task"]["name"] = "run/pole.py:Pole"
    checkpoints.save(run / "checkpoint", at)
    assert main(["verify", "run"]) == 2
    assert not (run / "executed").exists()


def test_settings_from_a_file_are_looked_at_as_well(run: Path) -> None:
    named(run, "run/pole.py:Pole")
    assert main(["run", "--config", "run/config.json", "--generations", "0"]) == 2
    assert not (run / "executed").exists()


@pytest.mark.parametrize(
    "name", ["run/pole.py:Pole", "{run}/pole.py:Pole", "/home/somebody/else/pole.py:Pole"]
)
def test_a_file_that_the_user_names_is_taken(
    run: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    named(run, name.format(run=run))
    (run.parent / "mine").mkdir()
    (run.parent / "mine" / "pole.py").write_text(POLE)
    for words in (
        ["verify", "run", "--share", "1"],
        ["export", "--list", "run"],
        ["evaluate", "run", "--rollouts=2"],
    ):
        assert main([*words, "--allow-file", "mine/pole.py"]) == 0
    assert "verified to the bit: 2 of 2 generations" in capsys.readouterr().out
    policy = farm.load("run", allow_file="mine/pole.py")
    assert policy.problem.config.task == f"{run.parent}/mine/pole.py:Pole"
    assert len(farm.rewind("run", 1, allow_file=run.parent / "mine/pole.py").returns) == 4
    assert not (run / "executed").exists()


def test_a_file_in_the_folder_may_be_named(run: Path) -> None:
    named(run, "run/pole.py:Pole")
    assert main(["evaluate", "run", "--rollouts", "2", "--allow-file", "run/pole.py"]) == 0
    assert (run / "executed").exists()


def test_a_file_that_is_not_here_is_asked_for(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "run"]) == 2
    assert (
        f"{run.parent}/pole.py, and there is no such file here; --allow-file pole.py"
        in capsys.readouterr().err
    )
    assert main(["evaluate", "run", "--allow-file", "nowhere.py"]) == 2
    assert "--allow-file nowhere.py: there is no such file" in capsys.readouterr().err


def test_a_table_of_runs_reads_only(run: Path) -> None:
    named(run, "run/pole.py:Pole")
    assert main(["runs", "."]) == 0
    assert not (run / "executed").exists()


def test_a_moved_run_is_resumed_with_the_users_file(run: Path) -> None:
    named(run, "run/pole.py:Pole")
    (run.parent / "pole.py").write_text(POLE)
    shutil.move(run, run.parent / "moved")
    folder = RunFolder.open(run.parent / "moved", (run.parent / "pole.py",))
    problem, at = setup.resumed(folder, folder.read_config())
    assert problem.config.task == f"{run.parent}/pole.py:Pole"
    assert at.state["generation"] == 2
