"""A run's configuration: to JSON and back, what is refused and with which words, what has changed."""

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from farm.errors import ConfigError
from farm.policies.fourier import PolicyConfig
from farm.tasks.finger_gait.task import TaskConfig
from learner import config as configs
from learner.algorithms import ALGORITHMS, PGPE
from learner.config import PRESETS, RunConfig

ODD = {
    "every choice another": RunConfig(
        task=TaskConfig(state="joints+tactile", reward="basic", weights="direct", steps=3, gamma=1.0, perturb=True),
        policy=PolicyConfig(controller="cosine", features=7, bandwidth=0.1 + 0.2, action="increment", clip=False),
        algorithm=PGPE(
            pairs=1, estimator="plain", normaliser="thesis", baseline="optimal", sigma_rule="positive",
            shaping="ranks", optimiser="adam", learning_rate_mu=5e-324, initial_mu=-0.0, initial_sigma=1e300,
        ),
        seed=2**32 - 1, generations=10_000_000, stop_when_solved=1, init_from="../Läufe/erster", init_sigma="fresh",
        traces="none",
    ),
    "nothing to do": RunConfig(generations=0),
}  # fmt: skip


@pytest.mark.parametrize("config", [*PRESETS.values(), *ODD.values()], ids=[*PRESETS, *ODD])
def test_there_and_back(config: RunConfig, tmp_path: Path) -> None:
    said = configs.to_dict(config)
    assert said["version"] == configs.VERSION
    path = tmp_path / "config.json"
    path.write_text(json.dumps(said), "utf-8")
    back = configs.read(path)
    assert back == config
    assert repr(back) == repr(config), "a type changed on the way"
    assert list(configs.changes(config, back)) == []


def test_presets_by_name() -> None:
    assert configs.preset("default") == RunConfig()
    with pytest.raises(ConfigError, match="unknown preset 'best'; known are default, thesis"):
        configs.preset("best")


def test_a_float_may_be_written_as_an_integer() -> None:
    values = configs.to_dict(RunConfig())
    values["task"]["gamma"] = 1
    gamma = configs.from_dict(values, "here").task.gamma
    assert (gamma, type(gamma)) == (1.0, float)


def test_what_is_missing_is_the_default() -> None:
    assert configs.from_dict({"version": 1}, "here") == RunConfig()
    assert configs.from_dict({"version": 1, "seed": 4}, "here") == RunConfig(seed=4)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"version": 2}, "not a configuration of version 1 (found 2)"),
    ({"version": None}, "not a configuration of version 1 (found None)"),
    ({"colour": "red"}, "unknown setting colour"),
    ({"task": {"colour": "red"}}, "unknown setting task.colour"),
    ({"task": 3}, "task is 3; expected a table of settings"),
    ({"seed": "4"}, "seed is '4'; expected int"),
    ({"seed": 1.0}, "seed is 1.0; expected int"),
    ({"seed": True}, "seed is True; expected int"),
    ({"seed": None}, "seed is None; expected int"),
    ({"seed": -1}, "seed is -1; expected 0 to 2^32 - 1"),
    ({"seed": 2**32}, "seed is 4294967296; expected 0 to 2^32 - 1"),
    ({"generations": -1}, "generations is -1; expected 0 to 10000000"),
    ({"generations": 10_000_001}, "generations is 10000001; expected 0 to 10000000"),
    ({"stop_when_solved": 0}, "stop-when-solved is 0; expected 1 or more"),
    ({"stop_when_solved": "soon"}, "stop_when_solved is 'soon'; expected int or NoneType"),
    ({"stop_when_solved": True}, "stop_when_solved is True; expected int or NoneType"),
    ({"init_from": 3}, "init_from is 3; expected str or NoneType"),
    ({"init_sigma": "old"}, "init-sigma is 'old'; known are run, fresh"),
    ({"traces": "some"}, "traces is 'some'; known are all, extremes, none"),
    ({"task": {"perturb": 1}}, "task.perturb is 1; expected bool"),
    ({"task": {"gamma": float("nan")}}, "gamma is nan; expected a number in (0, 1]"),
    ({"task": {"steps": 2}}, "steps is 2; expected 3 to 1000"),
    ({"policy": {"controller": "pid"}}, "'pid'"),
    ({"policy": {"bandwidth": float("inf")}}, "bandwidth"),
    ({"algorithm": {"name": "guess"}}, "unknown algorithm 'guess'; known are pgpe"),
    ({"algorithm": {"name": ["pgpe"]}}, "unknown algorithm ['pgpe']; known are pgpe"),
    ({"algorithm": {"pairs": 0}}, "pairs is 0, expected an integer of 1 or more"),
    ({"algorithm": {"estimator": "guess"}}, "estimator is 'guess', expected one of symmetric, plain"),
    ({"algorithm": {"initial_mu": float("nan")}}, "initial_mu"),
]


@pytest.mark.parametrize(("values", "words"), REFUSED, ids=lambda value: str(value)[:40])
def test_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        configs.from_dict({"version": 1, **values}, "over here")
    said = str(caught.value)
    assert said.startswith("over here: ")
    assert words in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("values", [None, [], "text", 3, {}])
def test_something_else_altogether(values: object) -> None:
    with pytest.raises(ConfigError, match="over here: not a configuration of version 1"):
        configs.from_dict(values, "over here")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the configuration .*none.json: No such file"):
        configs.read(tmp_path / "none.json")
    broken = tmp_path / "broken.json"
    for content in (b"{", b"\xff\xfe"):
        broken.write_bytes(content)
        with pytest.raises(ConfigError, match="is not JSON"):
            configs.read(broken)


def test_changes_are_told_by_their_flags() -> None:
    old = RunConfig()
    assert list(configs.changes(old, old)) == []
    task, algorithm = replace(old.task, gamma=0.5), replace(old.algorithm, learning_rate_mu=0.3)
    new = replace(old, seed=4, stop_when_solved=2, task=task, algorithm=algorithm)
    assert dict((name, (was, now)) for name, was, now in configs.changes(old, new)) == {
        "seed": (0, 4),
        "stop-when-solved": (None, 2),
        "gamma": (0.95, 0.5),
        "learning-rate-mu": (0.1, 0.3),
    }


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_no_two_settings_share_a_name(algorithm: Any) -> None:
    """Flags have no prefix, and changes are told without one."""
    tables = [RunConfig, TaskConfig, PolicyConfig, algorithm]
    fields = [field for table in tables for field in dataclasses.fields(table)]
    names = [field.name for field in fields if not dataclasses.is_dataclass(field.type)]
    assert len(names) == len(set(names))
    assert "name" not in names, "config.json keeps the algorithm's there"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walk:
    """An algorithm only as far as a configuration goes."""

    pairs: int = 5
    stride: float | None = None


@pytest.fixture
def walk(monkeypatch: pytest.MonkeyPatch) -> RunConfig:
    monkeypatch.setitem(ALGORITHMS, "walk", Walk)
    return RunConfig(algorithm=Walk(stride=0.5))  # type: ignore[arg-type]


def test_another_algorithm_there_and_back(walk: RunConfig) -> None:
    said = configs.to_dict(walk)
    assert said["algorithm"] == {"name": "walk", "pairs": 5, "stride": 0.5}
    assert configs.from_dict(json.loads(json.dumps(said)), "here") == walk
    said["algorithm"]["stride"] = None
    assert configs.from_dict(said, "here") == RunConfig(algorithm=Walk())  # type: ignore[arg-type]
    said["algorithm"]["stride"] = "long"
    with pytest.raises(ConfigError, match="stride is 'long'; expected float or NoneType"):
        configs.from_dict(said, "here")


def test_a_file_that_names_no_algorithm_means_pgpe(walk: RunConfig) -> None:
    said = configs.to_dict(RunConfig())
    assert said["algorithm"].pop("name") == "pgpe"
    assert configs.from_dict(said, "here") == RunConfig()
    del walk


def test_another_algorithm_is_a_change_of_its_name_and_of_what_both_have(walk: RunConfig) -> None:
    assert list(configs.changes(RunConfig(), walk)) == [("algorithm", "pgpe", "walk"), ("pairs", 15, 5)]
    assert configs.preset_of(walk) == "own"
