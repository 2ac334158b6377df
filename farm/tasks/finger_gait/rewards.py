"""Rewards of the thesis (3.5.2) as terms per step, and the return.

Pure functions of batches. A new reward is one function here and one line in REWARDS.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.tasks.base import Record
from farm.tasks.finger_gait.hand import LOWER, UPPER
from farm.tasks.finger_gait.observations import Felt

TERMS: Final = ("tactile", "joints", "action", "contact points", "drop")
"""Names of the reward's terms, in the order of every (..., 5) array of terms."""

RETURN_SCALE: Final = 0.1
"""Factor of the return (3.4)."""

_RANGE: Final = UPPER - LOWER


def _squares(difference: FloatArray) -> FloatArray:
    # Not a matrix product: its rounding depends on the processor
    return (difference * difference).sum(axis=-1)


@dataclass(frozen=True)
class Weights:
    """One row of Table 3.1."""

    tactile: float
    """a1"""
    joints: float
    """a2"""
    action: float
    """a3"""
    contact_points: float
    """a4"""
    drop: float
    """p"""


WEIGHTS: Final[dict[str, Weights]] = {
    # The thesis says "sensor range": the ranges of the controlled joints [rad].
    "direct": Weights(1.0, 30.0, 10.0 / float(_squares(_RANGE)), 1.0, 1000.0),
    "projected": Weights(0.1, 6.0, 1.0 / float(_RANGE.mean()), 6.0, 400.0),
}
"""Rows of Table 3.1 by the controller they were made for."""


Reward = Callable[[Felt, FloatArray, Felt, Weights], FloatArray]
"""Sensor values (..., 8 and so on), the action (..., 8), the demonstration and weights -> terms
(..., 5).
"""


def basic(felt: Felt, action: FloatArray, goal: Felt, weights: Weights) -> FloatArray:
    """Terms of (3.3): joints and action; W_q = a2 / (q_d' q_d) I and W_a = a3 I, which the thesis
    leaves open.
    """
    zero = np.zeros(felt.joints.shape[:-1])
    near = -weights.joints / float(_squares(goal.joints)) * _squares(felt.joints - goal.joints)
    return np.stack([zero, near, -weights.action * _squares(action), zero, zero], axis=-1)


def full(felt: Felt, action: FloatArray, goal: Felt, weights: Weights) -> FloatArray:
    """Terms of (3.5): tactile image, joints, action and contact points."""
    terms = basic(felt, action, goal, weights)
    touch = felt.images.reshape(*felt.images.shape[:-2], -1) - goal.images.reshape(-1)
    where = (felt.points - goal.points).reshape(*felt.points.shape[:-2], -1)
    terms[..., 0] = -weights.tactile / float(_squares(goal.images.reshape(-1))) * _squares(touch)
    terms[..., 3] = -weights.contact_points * _squares(where)
    return terms


def limited(felt: Felt, action: FloatArray, goal: Felt, weights: Weights) -> FloatArray:
    """Terms of (3.5), the action's penalty limited to a joint's range ("limit the action
    punishment", 4.1.1).
    """
    return full(felt, np.minimum(np.abs(action), _RANGE), goal, weights)


REWARDS: Final[dict[str, Reward]] = {"basic": basic, "full": full, "limited": limited}
"""Rewards by name."""


def end(
    terms: FloatArray, steps: IntArray, dropped: BoolArray, failed: BoolArray, weights: Weights
) -> FloatArray:
    """Cut the terms where each rollout ended and add the penalty there.

    Args:
      terms: (B, T, 5) from a reward for every step.
      steps: (B,) control steps of each rollout, including its last.
      dropped: (B,) whether the last of them ended without any contact: the penalty is added.
      failed: (B,) whether the simulation became unstable in the last of them: it gives the penalty
          only.
      weights: for the penalty p.

    Returns:
      (B, T, 5), zero after the end.
    """
    count, horizon, _ = terms.shape
    rows, last = np.arange(count), steps - 1
    out = np.where((np.arange(horizon) < steps[:, None])[..., None], terms, 0.0)
    out[rows[failed], last[failed]] = 0.0
    cut = dropped | failed
    out[rows[cut], last[cut], 4] = -weights.drop
    return out


def factors(reward: str, weights: Weights, goal: Felt) -> FloatArray:
    """Factors of the squares that a reward subtracts: tactile, joints, action, contact points,
    (4,).
    """
    full = float(reward != "basic")
    touch = full * weights.tactile / float(_squares(goal.images.reshape(-1)))
    near = weights.joints / float(_squares(goal.joints))
    return np.array([touch, near, weights.action, full * weights.contact_points])


def cut(terms: FloatArray, record: Record, worst: float) -> FloatArray:
    """Terms (B, T, K) with only the penalty `worst`, in the last of them, after each rollout's
    end.
    """
    over = np.arange(terms.shape[1]) >= record.steps[:, None]
    terms[over], terms[over, -1] = 0.0, -worst
    terms[record.failed] = np.where(over[record.failed][..., None], terms[record.failed], 0.0)
    return terms
