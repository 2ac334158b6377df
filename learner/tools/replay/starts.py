"""A policy from perturbed starts, counted as `farm evaluate` counts them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.net.work import Jobs, Simulated
from farm.seeds import SEEDS, evaluation_start
from farm.tasks.loop import Advance, unseen
from learner.tools.replay.loaded import LoadedPolicy, Replay
from learner.tools.replay.ranked import Ranked


@dataclass(frozen=True)
class Starts(Ranked):
    """A policy from the first starts of an evaluation, S of them."""

    policy: LoadedPolicy
    simulated: Simulated | None
    """Results; None if there are no starts"""

    @classmethod
    def tried(cls, policy: LoadedPolicy, count: int, advance: Advance = unseen) -> "Starts":
        """Simulate a policy from so many starts; `advance` is told how many are done."""
        jobs = Jobs.mean("none", [evaluation_start(0, i) for i in range(count)]) if count else None
        if jobs is None:
            return cls(policy, None)
        return cls(policy, policy.runner.run(policy.mu, jobs, advance=advance))

    @property
    def returns(self) -> FloatArray:
        """Return from each start, (S,)."""
        return np.empty(0) if self.simulated is None else self.simulated.returns

    @property
    def early(self) -> BoolArray:
        """Which starts have a rollout that the task ended early, (S,)."""
        return np.zeros(0, bool) if self.simulated is None else self.simulated.flags[:, 1]

    def again(self, numbers: Sequence[int]) -> list[Replay]:
        """Rollouts at physics rate from starts, also from others than those tried.

        Raises:
          ConfigError: there is no such start.
        """
        for each in numbers:
            if not 0 <= each < SEEDS:
                raise ConfigError(f"--seed {each}: expected a whole number from 0 to {SEEDS - 1}")
        theta = np.repeat(self.policy.mu[None], len(numbers), axis=0)
        return self.policy.rollouts(theta, [evaluation_start(0, each) for each in numbers])
