"""Controllers on random Fourier features (thesis 3.2 and 3.5.4), and what an action means.

Pure, batched. One action a_i for each of A controlled joints, the hand's eight or an environment's:

    direct     a_i = theta_i . z(x)                      D parameters a joint (thesis 3.7)
    projected  a_i = z(theta_i) . z(x)                   d parameters a joint (thesis 3.8)
    kernel     a_i = exp(-|theta_i - x|^2 / (2 h^2))     d parameters a joint: the limit D -> infinity of `projected`
    cosine     a_i = cos(theta_i) . z(x)                 D bounded parameters a joint (thesis 5.2, future work)

    z(x) = sqrt(2/D) cos(W x / h + c),  W ~ N(0, 1) of (D, d), c ~ U[0, 2 pi] of (D,)   (Rahimi & Recht 2007)

A rollout's numbers must not depend on who shares its batch. Matrix products over a batch do that (they change
their order of summation with the shape), so sums here are spelt out or run row by row. Nor on the processor, as
numpy's exp and cos do: these are the C library's, number by number, and `farm/elementary.py`'s.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.hand import LOWER, UPPER

CONTROLLERS: Final = ("direct", "projected", "kernel", "cosine")
_TARGET_LIMIT: Final = 1e6  # [rad]; keeps an unclipped target a number that MuJoCo takes


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """The controller."""

    controller: Literal["direct", "projected", "kernel", "cosine"] = "projected"
    """How parameters and state make an action (thesis 3.7, 3.8; kernel: projected at infinite D; cosine: 5.2)."""
    features: int = 8000
    """Number of random Fourier features, D (the kernel controller needs none)."""
    bandwidth: float = 1.0
    """Width h of the Gaussian kernel, in units of the state."""
    action: Literal["offset", "absolute", "increment"] = "offset"
    """What an action is [rad]: offset from the start grip's commands, joint position, or change of the last target."""
    clip: bool = True
    """Clip joint targets to the joints' ranges."""

    def __post_init__(self) -> None:
        """Check every value."""
        if self.controller not in CONTROLLERS:
            raise ConfigError(f"unknown controller {self.controller!r}; known are {', '.join(CONTROLLERS)}")
        if not 1 <= self.features <= 10_000_000:
            raise ConfigError(f"features is {self.features}; expected 1 to 10000000")
        if not 0 < self.bandwidth < np.inf:
            raise ConfigError(f"bandwidth is {self.bandwidth}; expected a positive number")
        if self.action not in ("offset", "absolute", "increment"):
            raise ConfigError(f"unknown action {self.action!r}; known are offset, absolute, increment")


@dataclass(frozen=True)
class Features:
    """Frequencies and phases of a feature map; drawn once a run and carried with it."""

    frequencies: FloatArray
    """W, (D, d)"""
    phases: FloatArray
    """c [rad], (D,)"""

    @classmethod
    def draw(cls, config: PolicyConfig, state_size: int, rng: np.random.Generator) -> "Features":
        """Draw them (none for the kernel controller)."""
        count = 0 if config.controller == "kernel" else config.features
        frequencies = rng.standard_normal((count, state_size))
        return cls(frequencies=frequencies, phases=rng.uniform(0.0, 2.0 * np.pi, count))


class Policy:
    """Deterministic controllers for a batch of parameter vectors."""

    def __init__(
        self,
        config: PolicyConfig,
        state_size: int,
        features: Features,
        limits: tuple[FloatArray, FloatArray] = (LOWER, UPPER),
    ) -> None:
        """Keep the feature map ready to use; limits are the least and greatest action, (A,) each."""
        self.config = config
        self._lower, self._upper = limits
        self.state_size = state_size
        # One contiguous row a state component: W x is then d multiply-adds of (D,) vectors, in order.
        self._rows = np.ascontiguousarray((features.frequencies / config.bandwidth).T)
        self._phases = features.phases
        self._scale = np.sqrt(2.0 / max(len(features.phases), 1))

    @property
    def joint_parameters(self) -> int:
        """Parameters a joint."""
        return self.state_size if self.config.controller in ("projected", "kernel") else len(self._phases)

    @property
    def size(self) -> int:
        """Length P of a parameter vector."""
        return len(self._lower) * self.joint_parameters

    def weights(self, theta: FloatArray) -> FloatArray:
        """What of the parameters does not change during a rollout, (B, P) -> (B, A, D or d)."""
        theta = np.ascontiguousarray(theta).reshape(len(theta), len(self._lower), -1)
        with np.errstate(over="ignore", invalid="ignore"):
            if self.config.controller == "projected":
                return np.stack([[self.features(joint) for joint in rollout] for rollout in theta])
            if self.config.controller == "cosine":
                return elementary.cos(theta)
            return theta

    def actions(self, weights: FloatArray, x: FloatArray) -> FloatArray:
        """Raw actions.

        Args:
          weights: (B, A, D or d) from `weights`.
          x: (B, d) states.

        Returns:
          (B, A), of the hand [rad]; may be huge or not finite with the direct controller.
        """
        weights, x = np.ascontiguousarray(weights), np.ascontiguousarray(x)  # numpy sums in the order of the memory
        with np.errstate(over="ignore", invalid="ignore"):
            if self.config.controller == "kernel":
                return self._kernel(weights, x)
            return np.stack([(w * self.features(row)).sum(axis=-1) for w, row in zip(weights, x, strict=True)])

    def features(self, x: FloatArray) -> FloatArray:
        """z(x) of one state, (d,) -> (D,)."""
        angle = self._phases.copy()
        product = np.empty_like(angle)
        for row, value in zip(self._rows, x, strict=True):
            np.multiply(row, value, out=product)
            angle += product
        return self._scale * elementary.cos(angle)

    def _kernel(self, theta: FloatArray, x: FloatArray) -> FloatArray:
        difference = theta - x[:, None, :]
        squares = (difference * difference).sum(axis=-1)
        exponents = squares * (-0.5 / self.config.bandwidth**2)
        # Number by number: of the few that one step has, numpy's calls for `elementary.exp` would take longer.
        return np.array(list(map(math.exp, exponents.ravel().tolist()))).reshape(exponents.shape)

    def targets(self, actions: FloatArray, start: FloatArray, last: FloatArray) -> FloatArray:
        """Joint targets.

        Args:
          actions: (B, 8) raw actions [rad].
          start: (8,) commands of the start grip [rad].
          last: (B, 8) targets of the step before [rad].

        Returns:
          (B, 8) [rad], finite.
        """
        base = {"offset": start, "absolute": 0.0, "increment": last}[self.config.action]
        targets = base + actions
        targets[np.isnan(targets)] = 0.0
        if self.config.clip:
            return np.minimum(np.maximum(targets, self._lower), self._upper)
        return np.minimum(np.maximum(targets, -_TARGET_LIMIT), _TARGET_LIMIT)

    def rescaled(self, actions: FloatArray) -> FloatArray:
        """Raw actions (B, A) between the limits: -1 is the least action, 1 the greatest, beyond is clipped."""
        part = np.minimum(np.maximum(actions, -1.0), 1.0)
        part[np.isnan(part)] = 0.0
        return self._lower + (self._upper - self._lower) * (0.5 * (part + 1.0))
