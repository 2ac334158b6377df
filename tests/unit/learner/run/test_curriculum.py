"""A run that begins with what was learnt of another task: what it takes over, and what it says."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, learnt
from made import pole

from farm import seeds
from farm.errors import ConfigError
from farm.moments import normaliser_of
from farm.policies.normalised import Normalised
from farm.runner import Runner
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import RunConfig, class_files, configure
from learner.run.folder import RunFolder
from learner.run.pilot import STARTS, piloted, tried

TASKS = (
    POLE
    + """
class Named(Pole):
    observations = (farm.Quantity("angle", "rad"), farm.Quantity("speed", "rad/s"))

class Heavy(Named):
    presets: ClassVar = {"default": {}}
    steps = 6
    observations = (farm.Quantity("angle", "rad"), farm.Quantity("rate", "rad/s"))

    @dataclass(frozen=True, kw_only=True)
    class Config(Pole.Config):
        wind: float = farm.setting(0.5)

    def files(self):
        return {**super().files(), "note": "read by somebody"}

    def reset(self, sim, row, rng):
        super().reset(sim, row, rng)
        sim.qpos[row, 0] += 1.0

class Blind(Pole):
    def observe(self, sim):
        return sim.qpos[:, :1]

class Idle(Pole):
    actions = 3

    def act(self, sim, action):
        return action[:, :1]
"""
)
LINEAR: dict[str, Any] = {"policy": "linear", "normalise": True, "pilot": True, "pairs": 4}


@pytest.fixture
def poles(tmp_path: Path) -> Path:
    path = tmp_path / "poles.py"
    path.write_text(TASKS)
    learnt(configure(f"{path}:Named", **LINEAR, generations=3, seed=3), tmp_path / "first")
    return path


def heir(poles: Path, task: str = "Heavy", **changed: Any) -> RunConfig:
    first = str(poles.parent / "first")
    return configure(f"{poles}:{task}", **{**LINEAR, **changed}, init_from=first, seed=4)


def test_a_harder_subclass_begins_with_mean_constants_and_statistics(poles: Path) -> None:
    other = checkpoints.load(poles.parent / "first" / "checkpoint")
    problem, at = setup.start(heir(poles), "second")
    assert at.state["mu"].tobytes() == other.state["mu"].tobytes()
    assert at.state["mu"].any()
    assert at.moments.tobytes() == other.moments.tobytes()
    assert at.moments[0] == 3 * 4 * 2 * 4, "of all exploring rollouts"
    for name, values in other.constants.items():
        assert problem.policy.constants[name].tobytes() == values.tobytes()
    initial = heir(poles).algorithm_config.initial_sigma  # type: ignore[attr-defined]
    assert (at.state["sigma"] == initial).all()
    assert (other.state["sigma"] != initial).any(), "the other one's has changed"


def in_heavy(poles: Path, starts: list[tuple[int, ...] | None]) -> np.ndarray:
    """Returns of the first run's mean, as it saw, in the harder task."""
    other = checkpoints.load(poles.parent / "first" / "checkpoint")
    problem = setup.problem(heir(poles), other.constants)
    policy = Normalised(problem.policy, normaliser_of(other.moments))
    theta = np.repeat(other.state["mu"][None], len(starts), axis=0)
    return Runner(problem.task, policy).rollouts(theta, starts).returns


def test_a_pilot_measures_around_the_mean_it_begins_with(poles: Path) -> None:
    base, *_ = tried(heir(poles))
    shared = [seeds.pilot_start(4, i) for i in range(STARTS)]
    assert base.returned == in_heavy(poles, list(shared)).mean()
    found = piloted(heir(poles))
    assert found.pilot_sigma is not None
    state = setup.start(found, "second")[1].state
    assert state["sigma"][0] == pytest.approx(found.pilot_sigma)
    given = heir(poles, initial_sigma=0.3, pilot=False)
    assert piloted(given) is given
    assert (setup.start(given, "second")[1].state["sigma"] == 0.3).all()


def test_learning_begins_there(poles: Path, tmp_path: Path) -> None:
    reports = learnt(piloted(heir(poles, generations=2)), tmp_path / "second")
    assert reports[0].progress.mean_policy_return == in_heavy(poles, [None])[0]


def test_a_run_of_the_same_task_goes_on_with_sigma_unless_that_is_to_begin_anew(
    poles: Path,
) -> None:
    same = heir(poles, "Named")
    assert piloted(same) is same
    assert setup.handed_over(same) == ""
    other = checkpoints.load(poles.parent / "first" / "checkpoint")
    assert setup.start(same, "second")[1].state["sigma"].tobytes() == other.state["sigma"].tobytes()
    fresh = heir(poles, "Named", init_sigma="fresh")
    assert piloted(fresh).pilot_sigma is not None


def test_a_line_says_what_differs(poles: Path) -> None:
    line = setup.handed_over(heir(poles, mass=2.0))
    assert (
        line
        == f"begins with the mean of {poles.parent / 'first'}; different here: task poles.py:Heavy"
        " (there poles.py:Named), mass 2.0 (there 1.0), wind 0.5, files note, observation 1"
        " 'rate' (there 'speed')"
    )
    assert "\n" not in line
    assert setup.handed_over(configure(f"{poles}:Heavy", **LINEAR)) == ""


def test_a_task_in_another_file(poles: Path, tmp_path: Path) -> None:
    other = tmp_path / "hills.py"
    other.write_text(TASKS)
    line = setup.handed_over(replace(heir(poles, "Named"), task=f"{other}:Named"))
    assert line.endswith("different here: task hills.py:Named (there poles.py:Named)")


def test_a_file_of_the_same_name_in_another_folder_is_another_task(
    poles: Path, tmp_path: Path
) -> None:
    hills = pole(tmp_path / "hills", TASKS, "poles.py")
    config = replace(heir(poles, "Named"), task=f"{hills}:Named")
    assert setup.handed_over(config).endswith(f"here: task {hills}:Named (there {poles}:Named)")
    assert piloted(config).pilot_sigma is not None
    poles.unlink()  # as on a machine that the other run was not made on
    assert setup.handed_over(config) == ""


def test_a_task_and_a_policy_in_two_files_of_one_name_go_on(tmp_path: Path) -> None:
    task = pole(tmp_path / "a", TASKS, "mine.py")
    policy = pole(
        tmp_path / "b",
        "import farm\nfrom farm.policies.networks import Linear\n\nclass Mine(Linear):\n    pass\n",
        "mine.py",
    )
    config = configure(f"{task}:Pole", policy=f"{policy}:Mine", pairs=2, generations=2)
    learnt(config, tmp_path / "r")
    folder = RunFolder.open(tmp_path / "r", class_files(config))
    assert setup.resumed(folder, folder.read_config())[0].config == config
    heir = replace(config, init_from=str(tmp_path / "r"))
    assert setup.start(heir, "second")[1].state["generation"] == 0


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            "Blind",
            (
                "in its task poles.py:Named an observation has 2 numbers, in poles.py:Blind 1: its"
                " policy"
            ),
        ),
        (
            "Idle",
            "in its task poles.py:Named an action has 1 numbers, in poles.py:Idle 3: its policy",
        ),
    ],
)
def test_other_sizes_are_refused_in_a_line(poles: Path, task: str, message: str) -> None:
    for begin in (setup.handed_over, piloted, lambda config: setup.start(config, "second")):
        with pytest.raises(ConfigError, match=message) as error:
            begin(heir(poles, task))
        assert "\n" not in str(error.value)
