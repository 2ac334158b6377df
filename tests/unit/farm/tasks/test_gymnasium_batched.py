"""Environments of Gymnasium in a batch: each step's observation, reward and end are the
environment's own.
"""

from functools import cache

import numpy as np
import pytest

from farm.policies.networks import Linear
from farm.returns import RETURN_FLOOR
from farm.runner import Runner
from farm.sim import quantities
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.loop import Batch, again

gymnasium = pytest.importorskip("gymnasium")

from farm.tasks.gymnasium import Environment, EnvironmentConfig, reset_seed  # noqa: E402
from farm.tasks.gymnasium_batched import batched  # noqa: E402
from farm.tasks.gymnasium_engine import EnvironmentEngine, make  # noqa: E402

ARGUMENTS = {
    "Swimmer-v5": (
        "exclude_current_positions_from_observation=false",
        "ctrl_cost_weight=0.3",
        "frame_skip=2",
    ),
    "HalfCheetah-v5": (
        "exclude_current_positions_from_observation=false",
        "forward_reward_weight=0.5",
    ),
    "Hopper-v5": (
        "terminate_when_unhealthy=false",
        "healthy_reward=0.7",
        "healthy_state_range=[-3,3]",
    ),
    "Walker2d-v5": (
        "healthy_z_range=[0.9,1.4]",
        "healthy_angle_range=[-0.3,0.3]",
        "reset_noise_scale=0.05",
    ),
    "Ant-v5": (
        "contact_force_range=[-3,2]",
        "main_body=2",
        "healthy_z_range=[0.3,0.9]",
        "contact_cost_weight=0.01",
    ),
    "Humanoid-v5": (
        "contact_cost_weight=0.001",
        "include_cinert_in_observation=false",
        "healthy_z_range=[1.2,2]",
    ),
    "InvertedPendulum-v5": ("reset_noise_scale=0.1",),
    "InvertedDoublePendulum-v5": ("healthy_reward=3.5", "reset_noise_scale=0.02"),
    "Reacher-v5": ("reward_dist_weight=2", "reward_control_weight=0.3"),
    "Pusher-v5": ("reward_near_weight=2", "reward_control_weight=0.3", "reward_dist_weight=0.7"),
}
CASES = [(name, arguments) for name, options in ARGUMENTS.items() for arguments in ((), options)]
STARTS = (None, (3, 0, 1, 0), (3, 0, 2, 0))


@cache
def new_task(name: str, arguments: tuple[str, ...] = ()) -> Environment:
    return Environment(
        EnvironmentConfig(env_arg=arguments, steps=100 if name in ("Pusher-v5",) else 0), name
    )


@pytest.mark.parametrize(
    ("name", "arguments"), CASES, ids=lambda value: value if isinstance(value, str) else len(value)
)
def test_numbers_with_a_joints_name_are_that_joints(name: str, arguments: tuple[str, ...]) -> None:
    task = new_task(name, arguments)
    names = [each.name for each in task.observations]
    states = [each.name for each in quantities.states(task.model)]
    sim = Sim(task.engine(lambda model: BatchEngine(model, 5)))

    def begin() -> Batch:
        batch = Batch(task, sim, [STARTS[1]])
        batch.observe()
        return batch

    observed = again(begin).observe()[0]
    state = np.concatenate([sim.qpos[0], sim.qvel[0]])
    named = [i for i, each in enumerate(names) if each in states]
    for i in named:
        assert observed[i] == state[states.index(names[i])]
    counted = name in ("InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5")
    assert bool(named) != counted
    assert len(names) == len(set(names)) == task.spec().observation


def test_actions_have_the_names_of_what_they_drive() -> None:
    names = [each.name for each in new_task("Hopper-v5").actions]
    assert names == ["thigh_joint", "leg_joint", "foot_joint"]


@pytest.mark.parametrize(
    ("name", "arguments"), CASES, ids=lambda value: value if isinstance(value, str) else len(value)
)
def test_every_step_is_the_environments(name: str, arguments: tuple[str, ...]) -> None:
    task = new_task(name, arguments)
    assert task.batched is not None
    sim, steps = Sim(task.engine(lambda model: BatchEngine(model, 5))), min(100, task.steps)

    def begin() -> Batch:
        rehearsal = Batch(task, sim, [*STARTS, STARTS[1]])  # two begin alike
        rehearsal.observe()
        rehearsal.step(np.zeros((4, len(task.limits[0]))))
        rehearsal.observe()
        return Batch(task, sim, [*STARTS, STARTS[1]])

    batch = again(begin)
    raw = np.random.default_rng(0).uniform(-1.2, 1.2, (steps, 4, len(task.limits[0])))
    envs = [make(name, **task.config.arguments) for _ in range(4)]
    observations = [
        env.reset(seed=reset_seed(None if start is None else np.random.default_rng(start)))[0]
        for env, start in zip(envs, [*STARTS, STARTS[1]], strict=True)
    ]
    going = list(range(4))
    for t in range(steps):
        if not going:
            break
        np.testing.assert_allclose(
            batch.observe(), [observations[row] for row in going], rtol=0, atol=1e-9
        )
        actions = task.act(sim, raw[t, going])
        batch.step(raw[t, going])
        for at, row in enumerate(list(going)):
            action = actions[at].astype(np.float32)
            observations[row], reward, terminated, *_ = envs[row].step(action)
            assert batch.terms is not None
            assert batch.terms[row, t, 0] == pytest.approx(reward, rel=0, abs=1e-9)
            assert batch.frames["qpos"][row, t].tolist() == envs[row].unwrapped.data.qpos.tolist()
            if terminated:
                going.remove(row)
        assert batch.active.tolist() == going


def test_physics_that_blows_up_is_never_good() -> None:
    task = Environment(
        EnvironmentConfig(env_arg=("reset_noise_scale=1e7",), steps=20), "HalfCheetah-v5"
    )
    linear = Linear(Linear.Config(), task.spec(), {})
    rollouts = Runner(task, linear).rollouts(np.zeros((1, linear.size)), [None])
    assert (rollouts.failed[0], rollouts.clamped[0], rollouts.returns[0]) == (
        True,
        True,
        RETURN_FLOOR,
    )


def test_others_step_themselves() -> None:
    for name, arguments in (("HumanoidStandup-v5", ()), ("Ant-v4", ()), ("Swimmer-v4", ())):
        task = Environment(EnvironmentConfig(env_arg=arguments), name)
        assert (task.batched, task.substeps) == (None, 1)
        assert isinstance(task.engine(lambda model: BatchEngine(model, 1)), EnvironmentEngine)


def test_an_environment_derived_from_one_is_not_it() -> None:
    from gymnasium.envs.mujoco.swimmer_v5 import SwimmerEnv

    class Slow(SwimmerEnv):
        pass

    gymnasium.register("Slow-v0", Slow, max_episode_steps=10)
    assert batched(make("Slow-v0")) is None
    gymnasium.register(
        "Same-v0", "gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv", max_episode_steps=10
    )
    assert batched(make("Same-v0")) is not None
