"""An exported ONNX model acts as the policy does."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.policies.normalised import Normalised
from learner.again.replay import LoadedPolicy
from learner.export import onnx
from learner.run.config import configure
from learner.run.setup import start

SETTINGS: dict[str, dict[str, Any]] = {
    "direct": {"features": 300},
    "projected": {"features": 300},
    "cosine": {"features": 300},
    "kernel": {"bandwidth": 1.3},
    "constant": {},
    "linear": {},
    "mlp": {"layers": (32, 16)},
    "rbf": {"centres": 4, "bandwidth": 0.7},
    "weighted-kernel": {},
}
MEMORY: dict[str, dict[str, Any]] = {"rnn": {"units": 5}, "cpg": {}}


def learnt(policy: str, normalise: bool = False) -> LoadedPolicy:
    config = configure(policy=policy, state="joints+contacts", normalise=normalise, **(SETTINGS | MEMORY)[policy])
    found, _ = start(config, "r")
    if normalise:
        seen = np.random.default_rng(2).uniform(0.5, 1.0, (2, found.spec.observation))
        found = replace(found, policy=Normalised(found.policy, seen))
    return LoadedPolicy(found, 7, np.random.default_rng(1).normal(0.3, 0.5, found.policy.size))


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("policy", SETTINGS)
def test_a_runtime_acts_as_the_policy_does(policy: str, normalise: bool, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    loaded = learnt(policy, normalise)
    own = loaded.problem.policy
    x = np.random.default_rng(3).normal(0.5, 0.5, (1000, loaded.problem.spec.observation))
    wanted = own.act(np.repeat(own.prepare(loaded.mu[None]), len(x), axis=0), x)
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    (given,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(given, wanted, rtol=1e-11, atol=1e-12)
    assert policy == "constant" or np.ptp(wanted, axis=0).min() > 1e-6
    said = session.get_modelmeta().custom_metadata_map
    assert (said["policy"], said["generation"], said["task"]) == (policy, "7", "finger-gait")


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("policy", ["rnn", "cpg"])
def test_a_memory_goes_in_and_comes_out(policy: str, normalise: bool, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    loaded = learnt(policy, normalise)
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    said = session.get_modelmeta().custom_metadata_map
    memory, acting = np.tile(json.loads(said["memory"]), (20, 1)), loaded.acting(20)
    rng, actions = np.random.default_rng(3), []
    for _ in range(10):
        x = rng.normal(0.5, 0.5, (20, loaded.problem.spec.observation))
        action, memory = session.run(["action", "next_memory"], {"observation": x, "memory": memory})
        np.testing.assert_allclose(action, acting.act(x), rtol=1e-10, atol=1e-11)
        actions.append(action)
    assert np.ptp(actions, axis=0).min() > 1e-6


def test_single_precision_is_exported_as_double(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    config = configure(policy="projected", features=300, precision="single")
    found, _ = start(config, "r")
    loaded = LoadedPolicy(found, 7, np.random.default_rng(1).normal(0.3, 0.5, found.policy.size))
    x = np.random.default_rng(3).normal(0.5, 0.5, (100, found.spec.observation))
    wanted = found.policy.act(np.repeat(found.policy.prepare(loaded.mu[None]), len(x), axis=0), x)
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    (given,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(given, wanted, atol=5e-6)


def test_a_policy_for_an_environment_of_gymnasium() -> None:
    runtime, _ = pytest.importorskip("onnxruntime"), pytest.importorskip("gymnasium")
    found, _ = start(configure("gym:Reacher-v5", policy="linear"), "r")
    loaded = LoadedPolicy(found, 0, np.random.default_rng(1).normal(size=found.policy.size))
    session = runtime.InferenceSession(onnx.contents(loaded), providers=["CPUExecutionProvider"])
    x = np.random.default_rng(3).normal(size=(4, 10))
    (given,) = session.run(None, {"observation": x})
    wanted = found.policy.act(np.repeat(loaded.mu[None], 4, axis=0), x)
    np.testing.assert_allclose(given, wanted, rtol=1e-11, atol=1e-12)


def test_other_policies_have_no_form() -> None:
    pytest.importorskip("onnx")
    loaded = learnt("linear")
    object.__setattr__(loaded.problem.config, "policy", "/home/me/own.py:Own")
    with pytest.raises(ConfigError, match=r"policy /home/me/own.py:Own has no form in ONNX; these have: direct, "):
        onnx.contents(loaded)


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"an .onnx file needs onnx: pip install onnx$"):
        onnx.contents(learnt("linear"))
