"""Starts, observations, rewards and ends of Gymnasium's MuJoCo environments, for a batch of
rollouts at once.

An environment steps one simulation at a time. Here the backend steps its model in a batch, and
these classes compute the rest. Settings are read from an environment made with the run's arguments.
Each class computes the same as the environment of its name in release 5
(gymnasium/envs/mujoco/NAME_v5.py, Farama Foundation), in its order and precision: actions are in
single precision. Sines, cosines and lengths may differ in the last bit.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final

import numpy as np

from farm import elementary
from farm.arrays import BoolArray, FloatArray
from farm.sim import quantities
from farm.sim.channels import Quantity
from farm.sim.sim import Sim


class Batched:
    """An environment without its physics; B rollouts."""

    hidden = 0
    """Positions that an observation leaves out by default."""
    most = np.inf
    """Limit of the observed velocities."""
    begins_with_states = True
    """Whether an observation begins with positions and velocities."""
    normal = False
    """Whether initial velocities are drawn from a normal distribution, not a uniform one."""

    def __init__(self, env: Any) -> None:  # noqa: ANN401  an unwrapped environment
        self.env, self.model = env, env.model
        self.qpos, self.qvel = env.init_qpos.copy(), env.init_qvel.copy()
        self.left_out = self.hidden * bool(
            getattr(env, "_exclude_current_positions_from_observation", False)
        )

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The positions and velocities with which an observation begins."""
        return quantities.states(self.model)[self.left_out :] if self.begins_with_states else ()

    def start(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Initial positions (nq,) and velocities (nv,)."""
        scale = self.env._reset_noise_scale
        qpos = self.qpos + rng.uniform(-scale, scale, self.model.nq)
        if self.normal:
            return qpos, self.qvel + scale * rng.standard_normal(self.model.nv)
        return qpos, self.qvel + rng.uniform(-scale, scale, self.model.nv)

    def before(self, sim: Sim) -> FloatArray:
        """Values before a control step that `reward` compares with, (B, ...)."""
        return np.array(sim.qpos)

    def observe(self, sim: Sim) -> FloatArray:
        """The observation, (B, d)."""
        return np.concatenate(
            [sim.qpos[:, self.left_out :], np.clip(sim.qvel, -self.most, self.most)], axis=1
        )

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:
        """The reward of the control step that just ended; `before` has the values from before it,
        (B,).
        """
        forward: FloatArray = self.env._forward_reward_weight * (
            (sim.qpos[:, 0] - before[:, 0]) / self.env.dt
        )
        return forward - self.env._ctrl_cost_weight * self.effort(sim)

    def effort(self, sim: Sim) -> FloatArray:
        """Squared length of the action in single precision, (B,)."""
        action = sim.ctrl.astype(np.float32)
        return np.square(action).sum(axis=1)

    def healthy(self, sim: Sim) -> BoolArray:
        """Which rollouts stand, (B,)."""
        return np.ones(len(sim), dtype=bool)

    def ended(self, sim: Sim) -> BoolArray:
        """Which rollouts the environment terminates, (B,).

        Those that fell, unless it lets them go on.
        """
        return ~self.healthy(sim) & bool(getattr(self.env, "_terminate_when_unhealthy", False))


class Swimmer(Batched):
    """Swimmer-v5."""

    hidden = 2


class HalfCheetah(Batched):
    """HalfCheetah-v5."""

    hidden, normal = 1, True


class Walker2d(Batched):
    """Walker2d-v5."""

    hidden, most = 1, 10.0

    def healthy(self, sim: Sim) -> BoolArray:
        """Which rollouts stand, (B,)."""
        return _within(sim.qpos[:, 1], self.env._healthy_z_range) & _within(
            sim.qpos[:, 2], self.env._healthy_angle_range
        )

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:
        """Speed, and a bonus for standing, less the effort."""
        forward: FloatArray = self.env._forward_reward_weight * (
            (sim.qpos[:, 0] - before[:, 0]) / self.env.dt
        )
        rewards = forward + self.healthy(sim) * self.env._healthy_reward
        return rewards - self.env._ctrl_cost_weight * self.effort(sim)


class Hopper(Walker2d):
    """Hopper-v5."""

    def healthy(self, sim: Sim) -> BoolArray:
        """Which rollouts stand with no other number out of range."""
        others = np.concatenate([sim.qpos, sim.qvel], axis=1)[:, 2:]
        return super().healthy(sim) & _within(others, self.env._healthy_state_range).all(axis=1)


class Ant(Batched):
    """Ant-v5."""

    hidden, normal = 2, True

    @cached_property
    def main(self) -> int:
        """Index of its main body."""
        return int(self.env.data.body(self.env._main_body).id)

    def before(self, sim: Sim) -> FloatArray:
        """Position of its main body, (B, 2)."""
        return np.array(sim.xpos[:, self.main, :2])

    def observe(self, sim: Sim) -> FloatArray:
        """Positions, velocities, and the forces of contacts."""
        parts = [sim.qpos[:, self.left_out :], sim.qvel]
        if self.env._include_cfrc_ext_in_observation:
            parts.append(self.forces(sim)[:, 1:].reshape(len(sim), -1))
        return np.concatenate(parts, axis=1)

    def forces(self, sim: Sim) -> FloatArray:
        """Forces of contacts on the bodies within their limits, (B, nbody, 6)."""
        return np.clip(_contact_forces(sim), *self.env._contact_force_range)

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:
        """Speed, and a bonus for standing, less the effort and the contacts."""
        speed = (sim.xpos[:, self.main, 0] - before[:, 0]) / self.env.dt
        gained = (
            speed * self.env._forward_reward_weight + self.healthy(sim) * self.env._healthy_reward
        )
        touch = _flat(self.forces(sim))
        cost = self.env._ctrl_cost_weight * self.effort(
            sim
        ) + self.env._contact_cost_weight * _squared(touch)
        return gained - cost

    def healthy(self, sim: Sim) -> BoolArray:
        """Which rollouts stand with all numbers finite."""
        low, high = self.env._healthy_z_range
        finite = np.isfinite(sim.qpos).all(axis=1) & np.isfinite(sim.qvel).all(axis=1)
        return finite & (low <= sim.qpos[:, 2]) & (sim.qpos[:, 2] <= high)


class Humanoid(Ant):
    """Humanoid-v5."""

    normal = False

    def before(self, sim: Sim) -> FloatArray:
        """Position of its centre of mass, (B, 2)."""
        mass = self.model.body_mass
        return (mass[:, None] * sim.xipos[:, :, :2]).sum(axis=1) / mass.sum()

    def observe(self, sim: Sim) -> FloatArray:
        """Positions and velocities, the links' inertias and velocities, forces of the motors and of
        contacts.
        """
        env, parts = self.env, [sim.qpos[:, self.left_out :], sim.qvel]
        if env._include_cinert_in_observation is True:
            parts.append(_flat(sim.cinert[:, 1:]))
        if env._include_cvel_in_observation is True:
            parts.append(_flat(sim.cvel[:, 1:]))
        if env._include_qfrc_actuator_in_observation is True:
            parts.append(sim.qfrc_actuator[:, 6:])
        if env._include_cfrc_ext_in_observation is True:
            parts.append(_flat(_contact_forces(sim)[:, 1:]))
        return np.concatenate(parts, axis=1)

    def effort(self, sim: Sim) -> FloatArray:
        """Squared length of the controls, (B,)."""
        return _squared(sim.ctrl)

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:
        """Speed, and a bonus for standing, less the effort and the contacts."""
        env = self.env
        speed = (self.before(sim)[:, 0] - before[:, 0]) / env.dt
        gained = env._forward_reward_weight * speed + self.healthy(sim) * env._healthy_reward
        touch = np.clip(
            env._contact_cost_weight * _squared(_flat(_contact_forces(sim))),
            *env._contact_cost_range,
        )
        return gained - (env._ctrl_cost_weight * self.effort(sim) + touch)

    def healthy(self, sim: Sim) -> BoolArray:
        """Which rollouts stand."""
        return _within(sim.qpos[:, 2], self.env._healthy_z_range)


class InvertedPendulum(Batched):
    """InvertedPendulum-v5."""

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:  # noqa: ARG002
        """1 for rollouts that stand."""
        return (~self.ended(sim)).astype(float)

    def ended(self, sim: Sim) -> BoolArray:
        """Which rollouts fell or have a number that is not finite, (B,)."""
        fell: BoolArray = np.abs(sim.qpos[:, 1]) > 0.2
        return fell | ~np.isfinite(self.observe(sim)).all(axis=1)


class InvertedDoublePendulum(Batched):
    """InvertedDoublePendulum-v5."""

    begins_with_states = False
    normal = True

    def observe(self, sim: Sim) -> FloatArray:
        """The cart's place, sines and cosines of the angles, velocities, and the force on the
        cart.
        """
        angles, speeds = sim.qpos[:, 1:], np.clip(sim.qvel, -10.0, 10.0)
        force = np.clip(sim.qfrc_constraint[:, :1], -10.0, 10.0)
        parts = [sim.qpos[:, :1], elementary.sin(angles), elementary.cos(angles), speeds, force]
        return np.concatenate(parts, axis=1)

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:  # noqa: ARG002
        """A bonus for standing, minus the tip's distance from its target and the speeds."""
        x, y = sim.site_xpos[:, 0, 0], sim.site_xpos[:, 0, 2]
        v1, v2 = sim.qvel[:, 1], sim.qvel[:, 2]
        bonus = self.env._healthy_reward * ~self.ended(sim)
        return bonus - (0.01 * x**2 + (y - 2) ** 2) - (1e-3 * v1**2 + 5e-3 * v2**2)

    def ended(self, sim: Sim) -> BoolArray:
        """Which rollouts have a low tip, (B,)."""
        low: BoolArray = sim.site_xpos[:, 0, 2] <= 1
        return low


class Reacher(Batched):
    """Reacher-v5."""

    begins_with_states = False

    def start(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """An arm near its zero, and a goal within a circle."""
        qpos = rng.uniform(-0.1, 0.1, self.model.nq) + self.qpos
        qpos[-2:] = _drawn(lambda: rng.uniform(-0.2, 0.2, 2), lambda length: length < 0.2)
        qvel = self.qvel + rng.uniform(-0.005, 0.005, self.model.nv)
        qvel[-2:] = 0.0
        return qpos, qvel

    def observe(self, sim: Sim) -> FloatArray:
        """Cosines and sines of the angles, the goal, the arm's speeds, and the way from the goal to
        the fingertip.
        """
        angles = sim.qpos[:, :2]
        away = self.way(sim, "fingertip", "target")[:, :2]
        parts = [
            elementary.cos(angles),
            elementary.sin(angles),
            sim.qpos[:, 2:],
            sim.qvel[:, :2],
            away,
        ]
        return np.concatenate(parts, axis=1)

    def way(self, sim: Sim, to: str, start: str) -> FloatArray:
        """The vector from one body to another [m], (B, 3)."""
        way: FloatArray = (
            sim.xpos[:, self.model.body(to).id] - sim.xpos[:, self.model.body(start).id]
        )
        return way

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:  # noqa: ARG002
        """Less the distance, and the effort."""
        near = -_length(self.way(sim, "fingertip", "target")) * self.env._reward_dist_weight
        return near + -self.effort(sim) * self.env._reward_control_weight


class Pusher(Reacher):
    """Pusher-v5."""

    def start(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """The arm as in the model, and the cylinder somewhere away from the goal."""
        place = _drawn(
            lambda: np.array([rng.uniform(-0.3, 0.0), rng.uniform(-0.2, 0.2)]),
            lambda length: length > 0.17,
        )
        qpos = self.qpos.copy()
        qpos[-4:] = *place, 0.0, 0.0
        qvel = self.qvel + rng.uniform(-0.005, 0.005, self.model.nv)
        qvel[-4:] = 0.0
        return qpos, qvel

    def observe(self, sim: Sim) -> FloatArray:
        """The arm's angles and speeds, and where its tip, the cylinder and the goal are."""
        places = [sim.xpos[:, self.model.body(name).id] for name in ("tips_arm", "object", "goal")]
        return np.concatenate([sim.qpos[:, :7], sim.qvel[:, :7], *places], axis=1)

    def reward(self, sim: Sim, before: FloatArray) -> FloatArray:  # noqa: ARG002
        """Less the distances of the cylinder to the goal and to the tip, and the effort."""
        near = -_length(self.way(sim, "object", "tips_arm")) * self.env._reward_near_weight
        far = -_length(self.way(sim, "object", "goal")) * self.env._reward_dist_weight
        return far + -self.effort(sim) * self.env._reward_control_weight + near


def _within(values: FloatArray, limits: tuple[float, float]) -> BoolArray:
    low, high = limits
    return (low < values) & (values < high)


def _contact_forces(sim: Sim) -> FloatArray:
    """Forces of contacts on every body, none before the first step, (B, nbody, 6)."""
    return np.zeros((len(sim), sim.model.nbody, 6)) if sim.t == 0 else sim.contact_forces()


def _flat(values: FloatArray) -> FloatArray:
    """(B, ...) -> (B, n)."""
    return np.ascontiguousarray(values).reshape(len(values), -1)


def _squared(values: FloatArray) -> FloatArray:
    """(B, n) -> (B,)."""
    return np.square(values).sum(axis=1)


def _length(vectors: FloatArray) -> FloatArray:
    """(B, 3) -> (B,)."""
    return np.sqrt((vectors * vectors).sum(axis=1))


def _drawn(draw: Any, fits: Any) -> FloatArray:  # noqa: ANN401  functions
    """The first of the drawn points (2,) whose distance from 0 is accepted."""
    while True:
        point: FloatArray = draw()
        if fits(np.sqrt((point * point).sum())):
            return point


_CLASSES: Final[Mapping[str, type[Batched]]] = {
    "swimmer_v5.SwimmerEnv": Swimmer,
    "half_cheetah_v5.HalfCheetahEnv": HalfCheetah,
    "hopper_v5.HopperEnv": Hopper,
    "walker2d_v5.Walker2dEnv": Walker2d,
    "ant_v5.AntEnv": Ant,
    "humanoid_v5.HumanoidEnv": Humanoid,
    "inverted_pendulum_v5.InvertedPendulumEnv": InvertedPendulum,
    "inverted_double_pendulum_v5.InvertedDoublePendulumEnv": InvertedDoublePendulum,
    "reacher_v5.ReacherEnv": Reacher,
    "pusher_v5.PusherEnv": Pusher,
}


def batched(env: Any) -> Batched | None:  # noqa: ANN401  as gymnasium.make gives it
    """The batched form of an environment; None if there is none."""
    kind = type(env.unwrapped)
    form = _CLASSES.get(f"{kind.__module__}.{kind.__name__}".removeprefix("gymnasium.envs.mujoco."))
    return None if form is None or env.spec.additional_wrappers else form(env.unwrapped)
