"""The pilot: which sigma it takes, for which runs, and that nothing else depends on it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from farm.errors import ConfigError, Interrupted
from learner.algorithms import PGPE
from learner.algorithms.ars import ARS
from learner.algorithms.cma import CMAES
from learner.algorithms.es import ES
from learner.algorithms.snes import SNES
from learner.commands import options
from learner.commands.run import RunCommand
from learner.run import config as configs
from learner.run.config import RunConfig, configure
from learner.run.pilot import Tried, choice, piloted, tried
from learner.run.setup import problem

TASK = '''
import numpy as np
from farm import Task

class Reach(Task):
    """A mass is to be at a place; it is lost for good where an action is larger than MOST."""

    xml = """<mujoco>
      <option gravity="0 0 0" timestep="0.05"/>
      <worldbody>
        <body>
          <joint name="x" type="slide" axis="1 0 0" damping="1"/>
          <geom size="0.1" mass="1"/>
        </body>
      </worldbody>
      <actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
    </mujoco>"""
    steps, substeps = 10, 2

    def reset(self, sim, row, rng):
        goal = sim.own.setdefault("goal", np.zeros(len(sim)))
        goal[row] = 0.5 if rng is None else rng.uniform(0.4, 0.6)
        sim.own.setdefault("lost", np.zeros(len(sim), dtype=bool))[row] = False

    def observe(self, sim):
        x = np.concatenate([sim.qpos, sim.qvel, sim.own["goal"][:, None]], axis=1)
        return np.concatenate([x, x * x], axis=1)

    def act(self, sim, action):
        sim.own["lost"] |= np.abs(action[:, 0]) > MOST
        return super().act(sim, action)

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0] - sim.own["goal"]) - 5.0 * sim.own["lost"]

    def ended(self, sim):
        return sim.own["lost"].copy()
'''


def reach(folder: Path, most: float) -> str:
    path = folder / "reach.py"
    path.write_text(TASK.replace("MOST", str(most)))
    return f"{path}:Reach"


def sigma_of(task: str, **changed: object) -> float:
    sigma = piloted(configure(task, **changed)).pilot_sigma
    assert sigma is not None
    return sigma


def test_it_explores_little_where_much_is_fatal(tmp_path: Path) -> None:
    wide = sigma_of(reach(tmp_path, 1e9))
    careful = tmp_path / "careful"
    careful.mkdir()
    assert sigma_of(reach(careful, 0.05)) < 0.4 * wide
    assert wide == pytest.approx(0.1 * 10**0.5)


def test_it_is_the_same_each_time_and_ends_where_exploring_is_cheap(tmp_path: Path) -> None:
    config = configure(reach(tmp_path, 0.05))
    base, *others = tried(config)
    assert [base, *others] == list(tried(config))
    assert base.sigma == 0.0
    assert [each.sigma for each in others] == pytest.approx(
        [0.1 * 10 ** (-k / 2) for k in range(len(others))]
    )
    assert [each.fits(base) for each in others] == [*[False] * (len(others) - 1), True]
    assert others[0].lost > others[-1].lost
    assert piloted(config).pilot_sigma == others[-1].sigma


def test_where_no_return_changes_the_run_begins_as_configured(tmp_path: Path) -> None:
    path = tmp_path / "flat.py"
    path.write_text(
        TASK.replace("MOST", "1e9").replace("-np.abs(sim.qpos[:, 0] - sim.own", "0.0 * (sim.own")
    )
    config = configure(f"{path}:Reach")
    assert piloted(config).pilot_sigma == config.algorithm_config.initial_sigma


def test_what_fits() -> None:
    base = Tried(sigma=0.0, returned=5.0, lost=0.25)
    each = Tried(sigma=0.1, returned=-1.0, lost=0.25, signal=1.0)
    assert each.fits(base)
    assert replace(each, returned=9.0, signal=0.0).fits(base), "it costs nothing"
    assert not replace(each, returned=-1.1).fits(base), "it costs more than it tells"
    assert replace(each, lost=0.35).fits(base)
    assert not replace(each, lost=0.36, signal=99.0).fits(base), "a robot that stands must not fall"
    assert replace(each, lost=1.0).fits(replace(base, lost=0.5)), "unless it falls anyway"
    assert not replace(each, returned=None).fits(base)
    assert each.fits(replace(base, returned=None))


def test_it_explores_further_where_that_returns_and_tells_more() -> None:
    base = Tried(sigma=0.0, returned=1.0, lost=0.0)
    usual = Tried(sigma=0.1, returned=2.0, lost=0.0, signal=1.0)
    far = Tried(sigma=0.3, returned=3.0, lost=0.0, signal=1.3)
    assert choice([base, usual, far]) == 0.3
    assert choice([base, usual, replace(far, returned=1.9)]) == 0.1, "it returns less"
    assert choice([base, usual, replace(far, signal=1.05)]) == 0.1, "it tells hardly more"
    assert choice([base, usual, replace(far, returned=None)]) == 0.1
    assert choice([base, usual]) == 0.1
    assert choice([base, usual, replace(far, sigma=0.03), replace(far, sigma=0.01)]) == 0.01


SPARSE = TASK.replace("MOST", "1e9").replace(
    'return -np.abs(sim.qpos[:, 0] - sim.own["goal"]) - 5.0 * sim.own["lost"]',
    "return (sim.qpos[:, 0] > 0.02).astype(float)",
)


def test_a_reward_that_the_first_policy_does_not_see_is_looked_for_further(tmp_path: Path) -> None:
    path = tmp_path / "sparse.py"
    path.write_text(SPARSE)
    config = configure(f"{path}:Reach")
    found = list(tried(config))
    assert [each.sigma for each in found] == pytest.approx([0.0, 0.1, 0.1 * 10**0.5])
    assert piloted(config).pilot_sigma == found[-1].sigma


def test_its_lines() -> None:
    assert Tried(sigma=0.0, returned=5.0, lost=0.0).line == "sigma 0: return 5"
    line = Tried(sigma=0.1, returned=None, lost=0.5, signal=2.0).line
    assert line == "sigma 0.1: return -, signal 2, 50% end early or fail"


def test_the_user_ends_it_before_anything_has_begun(tmp_path: Path) -> None:
    with pytest.raises(Interrupted, match="nothing has begun"):
        piloted(configure(reach(tmp_path, 1.0)), lambda: True)


@pytest.mark.parametrize(
    ("changed", "has_one"),
    [
        ({}, True),
        ({"algorithm": "snes"}, True),
        ({"pairs": 3, "sigma_cap": 0.1}, True),
        ({"sigma_floor": 1e-4}, False),
        ({"initial_sigma": 0.3}, False),
        ({"learning_rate_mu": 0.1}, False),
        ({"max_speed": 0.3}, False),
        ({"initial_sigma": 0.3, "pilot": True}, True),
        ({"pilot": False}, False),
    ],
)
def test_a_scale_that_is_given_wins(
    tmp_path: Path, changed: dict[str, object], has_one: bool
) -> None:
    task = reach(tmp_path, 1.0)
    assert configure(task, **changed).pilot is has_one
    words = ["--task", task]
    for name, value in changed.items():
        words.append(options.flag(name, str(value)))
    command, _, _ = options.parse(RunCommand, words, "farm run")
    assert command.run.pilot is has_one


def test_runs_without_one(tmp_path: Path) -> None:
    assert configure("finger-gait").pilot is False
    assert RunConfig(task="finger-gait").pilot is False
    assert RunConfig(task=reach(tmp_path, 1.0)).pilot is True
    own = tmp_path / "own.py"
    own.write_text(
        "from dataclasses import dataclass\nfrom farm import Settings\n\n@dataclass(frozen=True,"
        " kw_only=True)\nclass Own(Settings):\n    pairs: int = 2\n"
        + "".join(
            f"    def {name}(self, *a): ...\n"
            for name in ("signs", "init", "restore", "ask", "tell")
        )
    )
    config = configure(reach(tmp_path, 1.0), algorithm=f"{own}:Own")
    assert config.pilot is False
    with pytest.raises(ConfigError, match="has no method scaled"):
        replace(config, pilot=True)


def test_the_search_uses_what_it_found_and_the_file_repeats_it(tmp_path: Path) -> None:
    config = piloted(configure(reach(tmp_path, 0.05), seed=3))
    assert config.pilot_sigma is not None
    state = problem(config).begin()
    np.testing.assert_array_equal(state.sigma, np.full(state.mu.size, config.pilot_sigma))
    again = configs.from_dict(json.loads(json.dumps(configs.to_dict(config))), "config.json")
    assert again == config
    assert piloted(again) is again, "no second pilot"


@pytest.mark.parametrize(
    ("words", "pilot", "kept"),
    [
        ([], True, True),
        (["--seed", "7", "--pairs", "3"], True, True),
        (["--initial-sigma", "0.3"], False, False),
        (["--max-speed", "0.3"], False, False),
        (["--no-pilot"], False, False),
        (["--pilot"], True, False),
        (["--pilot-sigma", "0.02"], True, True),
        (["--algorithm", "snes"], True, False),
        (["--policy", "mlp"], True, False),
    ],
)
def test_what_was_found_for_one_search_is_not_used_for_another(
    tmp_path: Path, words: list[str], pilot: bool, kept: bool
) -> None:
    path = tmp_path / "config.json"
    path.write_text(json.dumps(configs.to_dict(configure(reach(tmp_path, 1.0), pilot_sigma=0.02))))
    command, _, _ = options.parse(RunCommand, ["--config", str(path), *words], "farm run")
    assert command.run.pilot is pilot
    assert command.run.pilot_sigma == (0.02 if kept else None)


@pytest.mark.parametrize(
    ("algorithm", "lengths"),
    [
        (PGPE(initial_sigma=2.0, sigma_floor=0.01), ("sigma_floor",)),
        (PGPE(optimiser="clipup"), ("learning_rate_mu", "max_speed", "sigma_floor")),
        (PGPE(optimiser="adam"), ("learning_rate_mu", "max_speed", "sigma_floor")),
        (ARS(), ("learning_rate_mu",)),
        (ES(), ("learning_rate_mu",)),
        (SNES(), ()),
        (CMAES(), ()),
    ],
)
def test_steps_are_in_proportion_to_sigma(algorithm: object, lengths: tuple[str, ...]) -> None:
    smaller = algorithm.scaled(algorithm.initial_sigma / 4.0)  # type: ignore[attr-defined]
    before, after = vars(algorithm), vars(smaller)
    changed = {name: after[name] / before[name] for name in before if before[name] != after[name]}
    assert changed == pytest.approx(dict.fromkeys(("initial_sigma", *lengths), 0.25))
    larger = algorithm.scaled(4.0 * algorithm.initial_sigma)  # type: ignore[attr-defined]
    if hasattr(algorithm, "sigma_floor"):
        assert larger.sigma_floor == algorithm.sigma_floor, "a floor only falls"
