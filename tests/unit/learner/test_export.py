"""An exported policy, played by the example, gives the return of our own rollout to the last bit."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from farm.policies.normalised import Normalised
from learner import export
from learner.config import configure
from learner.replay import LoadedPolicy
from learner.setup import start

EXAMPLE = Path(__file__).parents[3] / "examples" / "play_policy.py"
SETTINGS: dict[str, dict[str, Any]] = {
    "direct": {"features": 30},
    "projected": {"features": 30},
    "cosine": {"features": 30},
    "direct, single": {"features": 30, "precision": "single"},
    "projected, single": {"features": 30, "precision": "single"},
    "cosine, single": {"features": 30, "precision": "single"},
    "kernel": {},
    "constant": {"pose": "between", "motion": 0.3},
    "linear": {},
    "mlp": {"layers": (5, 3)},
    "rbf": {"centres": 4},
    "weighted-kernel": {},
}


def played(path: Path) -> float:
    """What the example says a policy returns."""
    spec = importlib.util.spec_from_file_location("play_policy", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    policy = module.Policy(path)
    policy.reset()
    total, held, t = 0.0, True, 0
    while held and t < policy.p["steps"]:
        reward, held = policy.step()
        total += policy.p["gamma"] ** t * reward
        t += 1
    return float(policy.p["return_scale"] * total)


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("policy", SETTINGS)
def test_the_example_plays_every_policy(policy: str, normalise: bool, tmp_path: Path) -> None:
    config = configure(
        policy=policy.partition(",")[0], state="joints+contacts", normalise=normalise, **SETTINGS[policy]
    )
    found, _ = start(config, "r")
    if normalise:
        seen = np.random.default_rng(2).uniform(0.5, 1.0, (2, found.spec.observation))
        found = replace(found, policy=Normalised(found.policy, seen))
    mu = np.random.default_rng(1).normal(0.3, 0.2, found.policy.size)
    learnt = LoadedPolicy(found, 0, mu)
    export.write(tmp_path / "p.npz", learnt)
    assert played(tmp_path / "p.npz") == learnt.rollout().trajectory.value
