"""Closed-loop rollouts in a MuJoCo environment of Gymnasium, one at a time.

A rollout's numbers depend on (environment, controller parameters, seed of the reset) alone. One at a time is
what Gymnasium offers; what is many at a time is the farm's workers.
"""

from typing import Final

import numpy as np

from farm import gym
from farm.arrays import FloatArray
from farm.policies.fourier import Policy
from farm.sim.scene import Scene
from farm.tasks.finger_gait.rewards import RETURN_FLOOR
from farm.tasks.finger_gait.task import TaskConfig
from workers.episodes import Episode, Episodes

NOMINAL: Final = 0
"""Seed of the reset where there is no perturbation."""


class Environment(Episodes):
    """Runs one run's jobs in an environment."""

    def __init__(self, config: TaskConfig, policy: Policy) -> None:
        """Make the environment.

        Raises:
          ConfigError: it is not to be had on this machine.
        """
        self._env = gym.make(config)
        super().__init__(config, policy, Scene(self._env.unwrapped.model))  # type: ignore[attr-defined]
        self._kind = self._env.action_space.dtype

    def close(self) -> None:
        """Give back the environment."""
        self._env.close()

    def episode(self, theta: FloatArray, perturbation: tuple[int, ...] | None) -> Episode:
        """One rollout of a controller (P,) from the start that a perturbation's seed gives."""
        weights = self.policy.weights(theta[None])
        x, _ = self._env.reset(seed=reset_seed(perturbation))
        qpos, actions, rewards = [self._qpos()], [], []
        value, failed, over = 0.0, False, False
        while not over:
            action = self.policy.rescaled(self.policy.actions(weights, np.asarray(x, dtype=float)[None]))[0]
            x, reward, terminated, truncated, _ = self._env.step(action.astype(self._kind))
            gain = float(reward)
            failed = not (np.isfinite(x).all() and np.isfinite(gain)) or gym.blown_up(self._env)
            value += self.gamma ** len(rewards) * gain
            qpos.append(self._qpos())
            actions.append(action)
            rewards.append(gain)
            over = failed or terminated or truncated or len(rewards) == self.sizes.steps
        return Episode(
            value=RETURN_FLOOR if failed or not value >= RETURN_FLOOR else value,
            failed=failed,
            qpos=np.array(qpos),
            actions=np.array(actions),
            rewards=np.array(rewards),
        )

    def _qpos(self) -> FloatArray:
        return np.array(self._env.unwrapped.data.qpos)  # type: ignore[attr-defined]


def reset_seed(perturbation: tuple[int, ...] | None) -> int:
    """Seed of an environment's reset: always the same one, or 128 bits drawn from the perturbation's seed."""
    if perturbation is None:
        return NOMINAL
    return int.from_bytes(np.random.SeedSequence(perturbation).generate_state(4).astype("<u4").tobytes(), "little")
