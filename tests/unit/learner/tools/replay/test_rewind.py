"""Exploring rollouts of a run repeated from their seeds: every return, to the last bit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alone import POLE, Alone

from farm.__main__ import main
from farm.arrays import FloatArray
from farm.errors import ConfigError
from learner.run import files, setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.tools.replay.rewind import rewind, under

GENERATIONS = 4
SETTINGS = (
    {},
    {"policy": "kernel", "optimiser": "clipup", "baseline": "optimal", "perturb": False},
    {"algorithm": "snes", "reward_offset": -0.5},
    {"interactions": 120, "policy": "linear"},
    {"interactions": 240, "policy": "linear", "episodes": 3, "reward_offset": -0.5},
    {"algorithm": "ars", "policy": "linear", "normalise": True},
    {"algorithm": "es", "policy": "mlp", "layers": (3,)},
    {"algorithm": "snes", "policy": "rnn", "units": 3, "normalise": True},
    {"algorithm": "cma-es", "policy": "cpg", "population": 6},
    {
        "algorithm": "cma-es",
        "policy": "linear",
        "population": 6,
        "reward_offset": 0.5,
        "episodes": 2,
    },
    {"algorithm": "sep-cma", "policy": "linear", "population": 6, "normalise": True},
)


@pytest.fixture
def task(tmp_path: Path) -> str:
    ends = (
        "\n    ending = 'fell'\n\n    def ended(self, sim):\n        return sim.qpos[:, 0] > 0.25\n"
    )
    (tmp_path / "pole.py").write_text(POLE + ends)
    return f"{tmp_path / 'pole.py'}:Pole"


def learnt(task: str, path: Path, **settings: object) -> list[FloatArray]:
    """A run; the returns of each generation's exploring rollouts as they came."""
    config = configure(task, generations=GENERATIONS, **settings)
    problem, at = setup.start(config, path.name)
    alone, returns = Alone(problem), []
    learner = Learner(problem, RunFolder.create(path, config), at)
    for _ in learner.learn(_Kept(alone, returns)):  # type: ignore[arg-type]
        pass
    return [values[: len(values) - 1] for values in returns]  # the mean policy's is the last


class _Kept:
    """Instead of the pool: keeps the results of every round, except replays of the best."""

    def __init__(self, alone: Alone, returns: list[FloatArray]) -> None:
        self._alone, self._returns = alone, returns

    def __getattr__(self, name: str) -> object:
        return getattr(self._alone, name)

    def collect(self) -> object:
        results = self._alone.collect()
        jobs = self._alone.rounds[-1][1]
        self._returns.append(results.returns[: int(jobs.rollouts[jobs.around].sum())].copy())
        return results


@pytest.mark.parametrize(
    "settings", SETTINGS, ids=lambda each: "-".join(map(str, each.values())) or "default"
)
def test_every_return_of_a_run_to_the_last_bit(
    task: str, tmp_path: Path, settings: dict[str, object]
) -> None:
    returns = learnt(task, tmp_path / "r", **settings)
    for generation, values in enumerate(returns, 1):
        again = rewind(tmp_path / "r", generation)
        assert again.returns.tobytes() == values.tobytes()
        assert again.rollout(1).trajectory.value == values[1]


def test_generations_that_are_not_stored(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "PARAMETERS_LIMIT", 120)
    returns = learnt(task, tmp_path / "r")
    assert len(RunFolder(tmp_path / "r").parameters.rows()) < GENERATIONS
    assert [rewind(tmp_path / "r", i + 1).returns.tolist() for i in range(GENERATIONS)] == [
        r.tolist() for r in returns
    ]


def test_a_run_that_began_from_another(
    task: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    learnt(task, tmp_path / "r")
    first = learnt(task, tmp_path / "s", init_from=str(tmp_path / "r"))[0]
    assert rewind(tmp_path / "s", 1).returns.tolist() == first.tolist()
    assert not caplog.messages
    learnt(task, tmp_path / "other", seed=1)
    (tmp_path / "other" / "checkpoint").replace(tmp_path / "r" / "checkpoint")
    assert rewind(tmp_path / "s", 1).returns.tolist() != first.tolist()
    (message,) = caplog.messages
    assert "these are not the rollouts of generation 1 to the last bit" in message
    assert "--init-from run have changed" in message


def test_the_best_the_worst_and_those_that_ended(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r")
    again = rewind(tmp_path / "r", 2)
    values = again.returns
    line = json.loads((tmp_path / "r" / "progress.jsonl").read_text().splitlines()[1])
    assert values[again.best(1)[0]] == line["return_max"]
    assert values[again.worst(1)[0]] == line["return_min"]
    assert sorted(again.best(len(values))) == sorted(again.worst(99)) == list(range(len(values)))
    early = again.ended(99)
    assert len(early) == line["ended"] > 0
    assert all(len(rollout.trajectory.times) < 5 for rollout in again.again(early))
    assert np.array_equal(
        rewind(tmp_path / "r").returns, rewind(tmp_path / "r", GENERATIONS).returns
    )


def test_a_rollout_of_an_episode_is_found_by_its_number(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r", episodes=3)
    again = rewind(tmp_path / "r", 2)
    assert again.theta[:8].tobytes() == again.theta[8:16].tobytes() == again.theta[16:].tobytes()
    assert [len(set(again.seeds[first : first + 8])) for first in (0, 8, 16)] == [1, 1, 1]
    assert again.rollout(19).trajectory.value == again.returns[19] != again.returns[11]


def test_under_other_settings_of_the_task(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r", algorithm="ars", policy="linear", normalise=True)
    folder = RunFolder(tmp_path / "r")
    settings, again = folder.read_config().task_config, rewind(folder.path, 3)
    for changed, same in ((settings, True), (replace(settings, mass=3.0), False)):  # type: ignore[call-arg]
        values = [
            rollout.trajectory.value
            for rollout in again.again([4, 1], under(folder, again, changed))
        ]
        assert (values == again.returns[[4, 1]].tolist()) == same


def test_a_number_of_pairs_that_cannot_be(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r", interactions=120)
    path = tmp_path / "r" / "progress.jsonl"
    first, *others = path.read_text().splitlines()
    path.write_text(
        "\n".join([json.dumps({**json.loads(first), "rollouts": 4_000_000}), *others, ""])
    )
    for generation in (1, 2):
        with pytest.raises(
            ConfigError, match=f"does not say how many pairs generation {generation} had"
        ):
            rewind(tmp_path / "r", generation)


def test_half_a_generation(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r", pairs=2)
    with pytest.raises(ConfigError, match=r"generation is 1\.5; expected a whole number from 1"):
        rewind(tmp_path / "r", 1.5)  # type: ignore[arg-type]
    assert rewind(tmp_path / "r", np.int64(2)).generation == 2  # type: ignore[arg-type]


def test_a_word_for_endings_that_replay_has_already(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    file = tmp_path / "pole.py"
    file.write_text(
        POLE
        + "\n    ending = 'best'\n\n    def ended(self, sim):\n        return sim.qpos[:, 0] < 9\n"
    )
    learnt(f"{file}:Pole", tmp_path / "r", pairs=2)
    words = ["replay", str(tmp_path / "r"), "--generation", "1", "--ended", "1"]
    assert main(words) == 0
    assert "generation 1, rollout 0: " in capsys.readouterr().out


def test_rollouts_that_there_are_not(task: str, tmp_path: Path) -> None:
    learnt(task, tmp_path / "r")
    for generation in (0, 9):
        with pytest.raises(
            ConfigError,
            match=f"generation {generation} of the run .* it has done generations 1 to 4",
        ):
            rewind(tmp_path / "r", generation)
    with pytest.raises(ConfigError, match="generation 1 has no rollout 8: there are 0 to 7"):
        rewind(tmp_path / "r", 1).rollout(8)
