"""`farm replay` of perturbed starts: the ones of `farm evaluate`, by their numbers, and the worst
of many.
"""

from pathlib import Path

import numpy as np
import pytest
from alone import POLE, learnt

import farm
from farm.__main__ import main
from farm.seeds import evaluation_start
from learner.run.config import configure
from learner.tools.evaluate.evaluate import evaluate


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Learnt; rollouts that reach an angle end."""
    folder = tmp_path_factory.mktemp("starts")
    task = (
        POLE
        + """
    ending = "fell"

    def ended(self, sim):
        return np.abs(sim.qpos[:, 0]) > 0.28
"""
    )
    (folder / "pole.py").write_text(task)
    learnt(configure(f"{folder / 'pole.py'}:Pole"), folder / "r")
    return folder / "r"


@pytest.fixture(scope="module")
def returns(run: Path) -> np.ndarray:
    """Of the first 40 starts."""
    policy = farm.load(run)
    theta = np.repeat(policy.mu[None], 40, axis=0)
    return policy.runner.rollouts(theta, [evaluation_start(0, i) for i in range(40)]).returns


def said(capsys: pytest.CaptureFixture[str], *words: object, status: int = 0) -> list[str]:
    assert main([str(word) for word in words]) == status
    output = capsys.readouterr()
    return (output.err if status else output.out).splitlines()


def test_a_start_is_the_one_of_an_evaluation(
    run: Path, returns: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.rrd"
    lines = said(capsys, "replay", run, "--seed", 7, "--to", path)
    assert (
        lines[0] == f"mean policy after generation 3, start 7: return {returns[7]:.3f}, it succeeds"
    )
    assert farm.load(run).rollout(seed=7).trajectory.value == returns[7]
    lines = said(capsys, "replay", run, "--seed", 7, "--seed", 31, "--to", path)
    assert [line.split(", ")[1].split(":")[0] for line in lines[:-1]] == ["start 7", "start 31"]
    assert path.stat().st_size > 1000


def test_the_worst_of_many_starts(
    run: Path, returns: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.rrd"
    order = np.argsort(returns)
    [line, _] = said(capsys, "replay", run, "--starts", 40, "--to", path)
    assert f"start {order[0]}: return {returns[order[0]]:.3f}" in line
    lines = said(capsys, "replay", run, "--starts", 40, "--best", 1, "--worst", 2, "--to", path)
    numbers = [int(line.split("start ")[1].split(":")[0]) for line in lines[:-1]]
    assert numbers == [order[-1], order[0], order[1]]
    figures = evaluate(run, rollouts=40, seed=0)
    assert figures["perturbed"]["worst_start"] == order[0]
    assert figures["perturbed"]["return_min"] == returns[order[0]]


def test_those_that_ended_and_other_settings(
    run: Path, returns: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.rrd"
    policy = farm.load(run)
    theta = np.repeat(policy.mu[None], 40, axis=0)
    fell = np.flatnonzero(
        policy.runner.rollouts(theta, [evaluation_start(0, i) for i in range(40)]).ended
    )
    assert 2 < len(fell) < 40
    lines = said(capsys, "replay", run, "--starts", 40, "--fell", 2, "--to", path)
    assert [int(line.split("start ")[1].split(":")[0]) for line in lines[:-1]] == fell[:2].tolist()
    [line, _] = said(capsys, "replay", run, "--seed", 7, "--mass", 3.0, "--to", path)
    assert line.startswith("mean policy after generation 3, mass 3.0, start 7: return ")
    assert f"{returns[7]:.3f}" not in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--seed", -1), "--seed -1: expected a whole number from 0 to 4294967295"),
        (("--seed", 2**32), "--seed 4294967296: expected a whole number from 0 to 4294967295"),
        (("--seed", 1, "--worst", 2), "--seed with --best, --worst or others: add --starts N"),
        (
            ("--seed", 1, "--rollout", 2),
            "--rollout is of a generation that explores, --seed and --starts of",
        ),
        (("--starts", 5, "--rollout", 2), "--rollout is of a generation that explores"),
        (("--starts", 0), "starts is 0; expected 1 to 100000"),
        (
            tuple(word for i in range(13) for word in ("--seed", i)),
            "13 rollouts are requested; at most 12",
        ),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    run: Path, words: tuple[object, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    [line] = said(capsys, "replay", run, *words, status=2)
    assert message in line


def test_an_evaluation_says_how_to_see_its_worst_start(
    run: Path,
    returns: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = said(capsys, "evaluate", run, "--rollouts", 40)
    assert lines[0] == "r, mean policy after generation 3"
    assert lines[-1] == f"the worst start: farm replay {run} --seed {returns.argmin()}"
    other = said(capsys, "evaluate", run, "--rollouts", 40, "--seed", 1)
    assert not any("--seed" in line for line in other), "those are other starts"


def test_a_replay_in_place_of_an_earlier_one_says_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.rrd"
    first, second = (said(capsys, "replay", run, "--to", path)[-1] for _ in range(2))
    assert first == f"written to {path}; look at it with: farm view {path}"
    assert second == (
        f"written to {path} in place of an earlier one (--to FILE keeps both); look at it with:"
        f" farm view {path}"
    )
