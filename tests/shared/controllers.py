"""Each kind of policy with constants drawn, and what it is given: parameters, observations and
memories.
"""

from typing import Any

import numpy as np

from farm.policies.base import Policy
from farm.policies.fourier import Cosine, Direct, Kernel, Projected
from farm.policies.networks import Linear, Mlp
from farm.policies.radial import Rbf, WeightedKernel
from farm.policies.recurrent import Cpg, Rnn
from farm.tasks.base import TaskSpec

ACTIONS = 3
FOURIER = {"direct": Direct, "projected": Projected, "kernel": Kernel, "cosine": Cosine}
SINGLE = {f"{name}, single": kind for name, kind in FOURIER.items() if name != "kernel"}
KINDS = (
    FOURIER
    | SINGLE
    | {
        "linear": Linear,
        "linear, no bias": Linear,
        "mlp": Mlp,
        "rbf": Rbf,
        "weighted-kernel": WeightedKernel,
    }
    | {"rnn": Rnn, "cpg": Cpg}
)


def make(
    name: str = "projected",
    features: int = 50,
    size: int = 8,
    seed: int = 0,
    bandwidth: float = 1.0,
) -> Policy:
    kind, spec = KINDS[name], TaskSpec(observation=size, action=ACTIONS, steps=1, period=0.1)
    settings: dict[str, Any] = {
        "kernel": {"bandwidth": bandwidth},
        "linear": {},
        "linear, no bias": {"bias": False},
        "mlp": {"layers": (features, 5)},
        "rbf": {"centres": features, "bandwidth": bandwidth},
        "weighted-kernel": {"width": bandwidth},
        "rnn": {"units": features},
        "cpg": {},
    }.get(name, {"features": features, "bandwidth": bandwidth})
    if name in SINGLE:
        settings["precision"] = "single"
    config, rng = kind.Config(**settings), np.random.default_rng(seed)
    constants = kind.draw(config, spec, rng)
    if kind.standardised:
        constants |= {"origin": rng.normal(size=size), "spread": rng.uniform(0.1, 2.0, size)}
    return kind(config, spec, constants)


def states(count: int, size: int = 8, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.2, (count, size))


def parameters(policy: Policy, count: int, seed: int = 4, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.5, scale, (count, policy.size))


def memories(policy: Policy, x: np.ndarray) -> tuple[np.ndarray, ...]:
    """Memories (B, m) that differ from row to row, in a tuple; an empty one for a policy
    without.
    """
    with np.errstate(over="ignore"):
        return (
            () if policy.memory is None else (x[:, :1] * np.linspace(0.1, 1.0, len(policy.memory)),)
        )


def act(policy: Policy, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    answer = policy.act(policy.prepare(theta), x, *memories(policy, x))
    return answer[0] if isinstance(answer, tuple) else answer


def acted(policy: Policy, prepared: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Actions, followed by the next memory if there is one, a row each."""
    answer = policy.act(prepared, x, *memories(policy, x))
    return np.concatenate(answer, axis=1) if isinstance(answer, tuple) else answer
