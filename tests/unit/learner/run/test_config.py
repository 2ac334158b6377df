"""A run's configuration: parts chosen by name, JSON, error messages, differences."""

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from farm.errors import ConfigError
from farm.policies.fourier import Cosine, Direct, Kernel
from farm.tasks.finger_gait.task import FingerGaitConfig
from learner.algorithms import PGPE
from learner.algorithms.snes import SNES
from learner.commands.options import LearnerOptions, flag, parse, run_name
from learner.commands.run import RunCommand
from learner.run import config as configs
from learner.run.config import RunConfig, changed_by, changes, configure, flags, presets

CODE = """
from dataclasses import dataclass
from typing import ClassVar
import farm

class Pole(farm.Task):
    xml = "<mujoco/>"
    presets: ClassVar = {
        "tall": {"length": 2.0, "pairs": 7},
        "small": {"algorithm": "pgpe", "features": 3},
    }

    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        length: float = farm.setting(1.0, above=0.0)
        sides: tuple[str, ...] = ()

class Plain(farm.Task):
    xml = "<mujoco/>"

class Clash(farm.Task):
    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        pairs: int = 3

class Bare(farm.Task):
    class Config(farm.TaskConfig):
        length: float = 1.0

class NoTask:
    pass

class Flat(farm.Task):
    presets = {"initial_sigma": 0.3}

class Strange(farm.Task):
    @dataclass(frozen=True, kw_only=True)
    class Config:
        length: float = 1.0

class Named(farm.Task):
    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        name: str = "x"

@dataclass(frozen=True, kw_only=True)
class Walk(farm.Settings):
    pairs: int = 5
    stride: float | None = None
    signs = init = restore = ask = tell = lambda *_: None
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mine") / "mine.py"
    path.write_text(CODE)
    return path


@pytest.fixture(scope="module")
def pole(file: Path) -> str:
    return f"{file}:Pole"


ODD = RunConfig(
    policy="cosine",
    task_config=FingerGaitConfig(
        state="joints+tactile",
        reward="basic",
        weights="direct",
        steps=3,
        gamma=1,
        perturb=True,
        action="increment",
        clip=False,
    ),
    policy_config=Cosine.Config(features=7, bandwidth=0.1 + 0.2),
    algorithm_config=PGPE(
        pairs=1,
        estimator="plain",
        normaliser="thesis",
        baseline="optimal",
        sigma_rule="positive",
        shaping="ranks",
        optimiser="adam",
        learning_rate_mu=5e-324,
        initial_mu=-0.0,
        initial_sigma=1e300,
    ),
    seed=2**32 - 1,
    generations=10_000_000,
    stop_when_solved=1,
    init_from="../Läufe/erster",
    init_sigma="fresh",
    traces="none",
)


# ---------------------------------------------------------------- parts and presets


def test_what_is_left_out_is_the_tasks_first_preset(pole: str, file: Path) -> None:
    assert (
        RunConfig() == configure() == configure("finger-gait", next(iter(presets("finger-gait"))))
    )
    config = RunConfig(task=pole)
    assert (config.policy, config.algorithm) == ("direct", "pgpe")
    assert (config.task_config.length, config.algorithm_config) == (2.0, PGPE(pairs=7))
    assert config == configure(pole) == configure(pole, "tall")
    assert configure(pole, "small").policy_config.features == 3
    assert configure(pole, "small").task_config.length == 1.0
    assert (
        RunConfig().generations,
        configure(preset="thesis").generations,
        config.generations,
    ) == (90, 150, 150)
    general = RunConfig(task=f"{file}:Plain")
    assert general == configure(f"{file}:Plain", "default")
    assert (general.policy_config.features, general.algorithm_config.optimiser) == (50, "clipup")
    with pytest.raises(
        ConfigError, match="unknown preset 'best' of task .*:Pole; known are tall, small"
    ):
        configure(pole, "best")


@pytest.mark.parametrize(
    ("observed", "policy", "bandwidth", "sigma"),
    [
        ("np.zeros((len(sim), 3))", "direct", 1.0, 1.0),
        ("np.zeros((len(sim), 4))", "direct", 2.0, 1.0),
        ("np.zeros((len(sim), 5))", "direct", 2.0, 1.0),
        ("np.zeros((len(sim), 6))", "linear", None, 0.1),
        ("1 / 0", "direct", 1.0, 1.0),
        ("exit(1)", "direct", 1.0, 1.0),
    ],
)
def test_the_general_policy_depends_on_what_a_task_observes(
    tmp_path: Path, observed: str, policy: str, bandwidth: float | None, sigma: float
) -> None:
    file = tmp_path / "slides.py"
    file.write_text(f"""
import farm
import numpy as np

class Slides(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="x" type="slide"/>
        <geom size="1"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>'''

    def observe(self, sim):
        return {observed}

    def reward(self, sim, action):
        return sim.qpos[:, 0]
""")
    config = RunConfig(task=f"{file}:Slides")
    assert (config.policy, config.algorithm) == (policy, "pgpe")
    assert config.policy_config.normalise
    assert getattr(config.policy_config, "bandwidth", None) == bandwidth
    assert config.algorithm_config.initial_sigma == sigma
    assert config == configure(f"{file}:Slides", "default")


def test_settings_by_their_flags(pole: str) -> None:
    config = configure(pole, length=3, features=9, pairs=2, seed=4)
    assert (
        config.task_config.length,
        config.policy_config.features,
        config.algorithm_config.pairs,
        config.seed,
    ) == (
        3,
        9,
        2,
        4,
    )
    with pytest.raises(ConfigError, match="unknown setting friction$"):
        configure(pole, friction=0.5)
    with pytest.raises(ConfigError, match=r"Pole: length is 0\.0; expected a positive number"):
        configure(pole, length=0)
    assert configure(friction=0.5).task_config.friction == 0.5


def test_a_part_that_is_chosen_anew_begins_with_its_own_defaults() -> None:
    old = configure(bandwidth=2.0, policy="direct", features=9, seed=3)
    same = changed_by(old, {"pairs": 4})
    assert same == replace(old, algorithm_config=replace(old.algorithm_config, pairs=4))
    new = changed_by(old, {"policy": "cosine"})
    assert (new.policy_config, new.task_config, new.seed) == (Cosine.Config(), old.task_config, 3)


def test_another_policy_or_algorithm_does_without_the_presets_settings_of_its_own(
    pole: str, file: Path
) -> None:
    config = configure(f"{file}:Plain", policy="kernel", algorithm=f"{file}:Walk")
    assert (config.policy_config, config.algorithm_config.pairs) == (
        Kernel.Config(bandwidth=1.0),
        5,
    )
    assert RunConfig(task=f"{file}:Plain", policy="kernel").policy_config == Kernel.Config(
        bandwidth=1.0
    )
    assert configure(pole, "small", policy="cosine").policy_config.features == 3
    assert configure(algorithm="snes").algorithm_config == SNES()
    assert configure(algorithm="snes", pairs=3).algorithm_config == SNES(pairs=3)
    with pytest.raises(ConfigError, match="unknown setting features"):
        configure(f"{file}:Plain", policy="kernel", features=3)


def test_a_presets_own_mistake_is_not_the_users(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(
        "import farm\n\nclass Own(farm.Task):\n    presets = {'quick': {'pears': 3, 'pairs': 2}}\n"
    )
    with pytest.raises(ConfigError, match=r"preset 'quick' of task .*:Own: unknown setting pears$"):
        configure(f"{path}:Own", pairs=4)
    with pytest.raises(ConfigError, match=r"^unknown setting apples$"):
        configure("finger-gait", apples=4)


@pytest.mark.parametrize(
    "settings",
    [
        {"pairs": "7"},
        {"preset": "thesis", "policy": "cosine"},
        {"policy": "mlp"},
        {"algorithm": "ars", "policy": "linear"},
        {"task": "POLE", "policy": "cosine", "preset": "small"},
        {"task": "POLE", "policy": "linear", "initial_sigma": "0.2"},
    ],
    ids=str,
)
def test_a_command_line_and_python_give_the_same_and_build_no_more_than_they_need(
    settings: dict[str, str], pole: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {name: pole if value == "POLE" else value for name, value in settings.items()}
    whole = RunConfig.__post_init__
    built = []

    def counted(self: RunConfig) -> None:
        built.append(self)
        whole(self)

    monkeypatch.setattr(RunConfig, "__post_init__", counted)
    words = [flag(name, value) for name, value in settings.items()]
    command, _, _ = parse(RunCommand, words, "farm run")
    assert len(built) <= 3, "what flags change, without a pilot where one says so, and the result"
    built.clear()
    numbers = {"pairs": int, "initial_sigma": float}
    values = {name: numbers.get(name, str)(value) for name, value in settings.items()}
    assert configure(**values) == command.run
    assert len(built) == 1


def test_names_that_two_parts_have_are_refused(file: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"setting 'pairs' of the algorithm 'pgpe' is also the task's"
    ):
        RunConfig(task=f"{file}:Clash")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NoTask", r"NoTask is not a Task: derive its class from farm\.Task"),
        ("Bare", r"put @dataclass\(frozen=True"),
        ("Flat", "presets of .*: expected tables of settings by name"),
        ("Strange", r"derive its Config from farm\.TaskConfig"),
        ("Named", "setting 'name' of the task .* is also the plug-in's"),
    ],
)
def test_classes_that_are_no_tasks_or_have_no_settings(file: Path, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        RunConfig(task=f"{file}:{name}")
    with pytest.raises(ConfigError, match="is not a Policy"):
        RunConfig(policy=f"{file}:Pole")
    with pytest.raises(ConfigError, match="is no algorithm: it needs signs"):
        RunConfig(algorithm=f"{file}:Pole")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"algorithm": "cma-es", "interactions": 9},
            "--interactions needs an algorithm with --pairs, which cma-es",
        ),
        ({"most_pairs": 9}, "--most-pairs is for --interactions: give both"),
        (
            {"pairs": 8, "interactions": 9, "most_pairs": 7},
            r"most-pairs is 7; expected at least 8 \(pairs\)",
        ),
        ({"interactions": 0}, "interactions is 0; expected 1 or more"),
    ],
)
def test_populations_that_cannot_be(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        configure(**settings)


# ---------------------------------------------------------------- config.json


def test_there_and_back(pole: str, tmp_path: Path) -> None:
    variants = [configure("finger-gait", name) for name in presets("finger-gait")]
    for config in (
        *variants,
        ODD,
        RunConfig(generations=0),
        configure(pole, sides=("left", "right")),
    ):
        table = configs.to_dict(config)
        assert table["version"] == configs.VERSION == 2
        path = tmp_path / "config.json"
        path.write_text(json.dumps(table), "utf-8")
        back = configs.read(path)
        assert back == config
        assert repr(back) == repr(config), "a type changed on the way"
        assert list(changes(config, back)) == []


def test_what_is_missing_of_the_settings_is_their_default() -> None:
    parts = {
        "task": {"name": "finger-gait"},
        "policy": {"name": "direct"},
        "algorithm": {"name": "pgpe"},
    }
    config = configs.from_dict({"version": 2, "seed": 4, **parts}, "here")
    assert config == RunConfig(
        policy="direct",
        task_config=FingerGaitConfig(),
        policy_config=Direct.Config(),
        algorithm_config=PGPE(),
        seed=4,
    )


REFUSED: list[tuple[tuple[str, ...], object, str]] = [
    (("version",), 1, "not a configuration of version 2 (found '1')"),
    (("version",), None, "not a configuration of version 2 (found 'None')"),
    (("colour",), "red", "unknown setting colour"),
    (("task_config",), {}, "unknown setting task_config"),
    (("task",), 3, "task is '3'; expected a table of settings with a name"),
    (
        ("policy",),
        {"features": 3},
        "policy is \"{'features': 3}\"; expected a table of settings with a name",
    ),
    (("task", "name"), "juggling", "unknown task 'juggling'"),
    (("policy", "name"), "pid", "unknown policy 'pid'"),
    (("algorithm", "name"), "guess", "unknown algorithm 'guess'; known are pgpe"),
    (("algorithm", "name"), ["pgpe"], "expected a table of settings with a name"),
    (("task", "colour"), "red", "task: unknown setting colour"),
    (("task", "length"), 1.0, "task: unknown setting length"),
    (("policy", "friction"), 1.0, "policy: unknown setting friction"),
    (("seed",), "4", "seed is '4'; expected int"),
    (("seed",), 1.0, "seed is 1.0; expected int"),
    (("seed",), True, "seed is True; expected int"),
    (("seed",), -1, "seed is -1; expected 0 to 4294967295"),
    (("seed",), 2**32, "seed is 4294967296; expected 0 to 4294967295"),
    (("generations",), 10_000_001, "generations is 10000001; expected 0 to 10000000"),
    (("stop_when_solved",), 0, "stop-when-solved is 0; expected 1 or more"),
    (("init_from",), 3, "init-from is 3; expected str or nothing"),
    (("init_sigma",), "old", "unknown init-sigma 'old'; known are run, fresh"),
    (("traces",), "some", "unknown traces 'some'; known are all, extremes, none"),
    (("task", "perturb"), 1, "task: perturb is 1; expected bool"),
    (("task", "gamma"), float("nan"), "gamma is nan; expected a finite number"),
    (("policy", "bandwidth"), float("inf"), "bandwidth is inf; expected a finite number"),
    (("algorithm", "pairs"), 0, "algorithm: pairs is 0; expected 1 or more"),
    (("algorithm", "estimator"), "guess", "unknown estimator 'guess'; known are symmetric, plain"),
]


@pytest.mark.parametrize(("keys", "value", "words"), REFUSED, ids=lambda value: str(value)[:40])
def test_refused(keys: tuple[str, ...], value: object, words: str) -> None:
    contents: Any = configs.to_dict(RunConfig())
    table = contents if len(keys) == 1 else contents[keys[0]]
    table[keys[-1]] = value
    with pytest.raises(ConfigError) as caught:
        configs.from_dict(contents, "over here")
    line = str(caught.value)
    assert words in line
    assert len(line.splitlines()) == 1


@pytest.mark.parametrize("values", [None, [], "text", 3, {}])
def test_something_else_altogether(values: object) -> None:
    with pytest.raises(ConfigError, match="over here: not a configuration of version 2"):
        configs.from_dict(values, "over here")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*none\.json: No such file"):
        configs.read(tmp_path / "none.json")
    broken = tmp_path / "broken.json"
    for content in (b"{", b"\xff\xfe", b"[" * 100_000):
        broken.write_bytes(content)
        with pytest.raises(ConfigError, match="is not JSON"):
            configs.read(broken)


# ---------------------------------------------------------------- changes


def test_changes_are_told_by_their_flags() -> None:
    old = configure(gamma=0.9, learning_rate_mu=0.1)
    assert list(changes(old, old)) == []
    new = changed_by(old, {"seed": 4, "stop_when_solved": 2, "gamma": 0.5, "learning_rate_mu": 0.3})
    assert {name: (was, now) for name, was, now in changes(old, new)} == {
        "seed": (0, 4),
        "stop-when-solved": (None, 2),
        "gamma": (0.9, 0.5),
        "learning-rate-mu": (0.1, 0.3),
    }


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"initial_sigma": 0.3},
        {"initial_sigma": 0.3, "pilot": True},
        {"initial_sigma": 0.3, "pilot": False},
        {"pilot": False},
        {"policy": "mlp", "layers": (3, 4), "normalise": False, "seed": 3},
    ],
)
def test_flags_give_the_configuration_again(pole: str, changed: dict[str, Any]) -> None:
    config = configure(pole, **changed)
    again, *_ = parse(RunCommand, flags(config), "farm run")
    assert again.run == config


def test_a_run_to_begin_from_is_found_from_every_folder(
    pole: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert configure(pole, init_from="runs/a").init_from == str(tmp_path / "runs/a")


def test_of_another_plug_in_only_what_both_have_is_a_change(file: Path) -> None:
    walk = changed_by(RunConfig(), {"algorithm": f"{file}:Walk", "stride": 0.5, "pairs": 6})
    assert [change[0] for change in changes(RunConfig(), walk)] == ["algorithm", "pairs"]
    assert configs.preset_of(walk) == "own"
    assert configs.from_dict(json.loads(json.dumps(configs.to_dict(walk))), "here") == walk


@pytest.mark.parametrize("task", ["finger-gait", "mine"])
def test_presets_are_known_by_what_they_set(task: str, pole: str) -> None:
    name = pole if task == "mine" else task
    for preset in presets(name):
        config = configure(name, preset, seed=9, generations=3)
        assert configs.preset_of(config) == preset
        assert configs.preset_of(changed_by(config, {"gamma": 0.123})) == "own"
        assert configs.properties(config)["preset"] == preset


def test_runs_of_one_second_have_names_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.gmtime", lambda: time.struct_time((2026, 1, 2, 3, 4, 5, 4, 2, 0)))
    options, names = LearnerOptions(out=tmp_path), []
    for _ in range(3):
        names.append(run_name(options, RunConfig()))
        (tmp_path / names[-1]).mkdir()
    first = "finger-gait-default-s0-20260102-030405"
    assert names == [first, f"{first}-2", f"{first}-3"]
    long = replace(options, config=tmp_path / f"my settings {'x' * 90}.json")
    assert run_name(long, RunConfig()) == (
        "finger-gait-my-settings-xxxxxxxxxxxxxxxxxx-s0-20260102-030405"
    )
