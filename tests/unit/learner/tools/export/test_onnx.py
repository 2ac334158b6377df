"""An exported ONNX model acts as the policy does."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.policies.normalised import Normalised
from learner.run.config import configure
from learner.run.setup import start
from learner.tools.export import onnx
from learner.tools.replay.loaded import LoadedPolicy

pytestmark = pytest.mark.usefixtures("grips_found_once")

HOPPER = f"{Path(__file__).parents[5]}/examples/tasks/hopper.py:Hopper"
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
    config = configure(HOPPER, policy=policy, normalise=normalise, **(SETTINGS | MEMORY)[policy])
    problem, _ = start(config, "r")
    if normalise:
        normaliser = np.random.default_rng(2).uniform(0.5, 1.0, (2, problem.spec.observation))
        problem = replace(problem, policy=Normalised(problem.policy, normaliser))
    return LoadedPolicy(problem, 7, np.random.default_rng(1).normal(0.3, 0.5, problem.policy.size))


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("policy", SETTINGS)
def test_a_runtime_acts_as_the_policy_does(policy: str, normalise: bool, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    loaded = learnt(policy, normalise)
    actor = loaded.problem.policy
    x = np.random.default_rng(3).normal(0.5, 0.5, (1000, loaded.problem.spec.observation))
    expected = actor.act(np.repeat(actor.prepare(loaded.mu[None]), len(x), axis=0), x)
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    (actions,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(actions, expected, rtol=1e-11, atol=1e-12)
    assert policy == "constant" or np.ptp(expected, axis=0).min() > 1e-6
    metadata = session.get_modelmeta().custom_metadata_map
    assert (metadata["policy"], metadata["generation"], metadata["task"]) == (
        policy,
        "7",
        "hopper.py:Hopper",
    )


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("policy", ["rnn", "cpg"])
def test_a_memory_goes_in_and_comes_out(policy: str, normalise: bool, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    loaded = learnt(policy, normalise)
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    memory, acting = np.tile(json.loads(metadata["memory"]), (20, 1)), loaded.acting(20)
    rng, actions = np.random.default_rng(3), []
    for _ in range(10):
        x = rng.normal(0.5, 0.5, (20, loaded.problem.spec.observation))
        action, memory = session.run(
            ["action", "next_memory"], {"observation": x, "memory": memory}
        )
        np.testing.assert_allclose(action, acting.act(x), rtol=1e-10, atol=1e-11)
        actions.append(action)
    assert np.ptp(actions, axis=0).min() > 1e-6


def test_single_precision_is_exported_as_double(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    config = configure(policy="projected", features=300, precision="single")
    problem, _ = start(config, "r")
    loaded = LoadedPolicy(
        problem, 7, np.random.default_rng(1).normal(0.3, 0.5, problem.policy.size)
    )
    x = np.random.default_rng(3).normal(0.5, 0.5, (100, problem.spec.observation))
    expected = problem.policy.act(
        np.repeat(problem.policy.prepare(loaded.mu[None]), len(x), axis=0), x
    )
    onnx.write(tmp_path / "p.onnx", loaded)
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    (actions,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(actions, expected, atol=5e-6)


def test_a_policy_for_an_environment_of_gymnasium() -> None:
    runtime, _ = pytest.importorskip("onnxruntime"), pytest.importorskip("gymnasium")
    problem, _ = start(configure("gym:Reacher-v5", policy="linear"), "r")
    loaded = LoadedPolicy(problem, 0, np.random.default_rng(1).normal(size=problem.policy.size))
    session = runtime.InferenceSession(onnx.contents(loaded), providers=["CPUExecutionProvider"])
    x = np.random.default_rng(3).normal(size=(4, 10))
    (actions,) = session.run(None, {"observation": x})
    expected = problem.policy.act(np.repeat(loaded.mu[None], 4, axis=0), x)
    np.testing.assert_allclose(actions, expected, rtol=1e-11, atol=1e-12)


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"an .onnx file needs onnx: pip install onnx$"):
        onnx.contents(learnt("linear"))


OWN = """import numpy as np

from farm import Policy


class {name}(Policy):
    @property
    def size(self):
        return self.spec.action * self.spec.observation

    @property
    def memory(self):
        return np.zeros(self.spec.action)

    def act(self, prepared, x, memory):
        rows = prepared.reshape(len(x), self.spec.action, -1)
        pull = (rows * np.maximum(x, 0.0)[:, None]).sum(axis=-1)
        return pull - 0.5 * memory, pull

    def onnx(self, graph, theta, x, memory):
        {body}
"""
GOOD = """matrix = theta.reshape(self.spec.action, -1).T.copy()
        pull = graph.put("MatMul", graph.put("{operator}", x), matrix)
        return graph.put("Sub", pull, graph.put("Mul", memory, 0.5)), pull
"""


def policy_with(folder: Path, body: str) -> LoadedPolicy:
    (folder / "own.py").write_text(OWN.format(name="Own", body=body))
    problem, _ = start(configure(HOPPER, policy=f"{folder}/own.py:Own"), "r")
    return LoadedPolicy(problem, 0, np.random.default_rng(1).normal(size=problem.policy.size))


def test_a_policy_of_ones_own_has_a_method(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    loaded = policy_with(tmp_path, GOOD.format(operator="Relu"))
    session = runtime.InferenceSession(onnx.contents(loaded), providers=["CPUExecutionProvider"])
    x, memory = np.random.default_rng(3).normal(size=(2, 5, 11)), np.zeros((5, 3))
    acting = loaded.acting(5)
    for each in x:
        action, memory = session.run(
            ["action", "next_memory"], {"observation": each, "memory": memory}
        )
        np.testing.assert_allclose(action, acting.act(each), rtol=1e-11, atol=1e-12)
    assert session.get_modelmeta().custom_metadata_map["policy"] == "own.py:Own"


def test_the_method_on_the_page_suits_the_policy_on_another(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    docs = Path(__file__).parents[5] / "docs"
    [policy] = re.findall(
        r"`linear.py`:\n\n```python\n(.*?)```", (docs / "extending.md").read_text("utf-8"), re.S
    )
    [method] = re.findall(
        r"^(    def onnx.*?)\n\n", (docs / "export.md").read_text("utf-8"), re.S | re.M
    )
    (tmp_path / "linear.py").write_text(f"{policy}\n{method}\n")
    problem, _ = start(configure(HOPPER, policy=f"{tmp_path}/linear.py:Linear"), "r")
    loaded = LoadedPolicy(problem, 0, np.random.default_rng(1).normal(size=problem.policy.size))
    assert b"linear.py:Linear" in onnx.contents(loaded), "it has been compared with the policy"


@pytest.mark.parametrize(
    ("body", "line"),
    [
        (
            GOOD.format(operator="Tanh"),
            r"onnx of .*own.py:Own gives action 0 as -?[\d.]+ in state 0 of 1000; act gives ",
        ),
        (
            GOOD.format(operator="Twist"),
            r"onnx of .*own.py:Own makes no model: No Op registered for Twist",
        ),
        (
            'return "pull"',
            (
                r"onnx of .*own.py:Own gave 'pull'; expected the name of action and that of"
                r" next_memory"
            ),
        ),
        ('return "pull", "pull"', r"onnx of .*own.py:Own makes no model: .*pull"),
        (
            "return x, memory",
            r"own.py:Own gives actions of shape \(1000, 11\); expected \(1000, 3\), as act",
        ),
        (
            "raise NotImplementedError",
            r"own.py:Own has no form in ONNX: give it a method onnx\(self, graph, theta, x",
        ),
    ],
)
def test_a_wrong_form_is_refused(body: str, line: str, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    loaded = policy_with(tmp_path, body)
    (tmp_path / "p.onnx").write_bytes(b"an earlier one")
    with pytest.raises(ConfigError, match=line):
        onnx.write(tmp_path / "p.onnx", loaded)
    assert (tmp_path / "p.onnx").read_bytes() == b"an earlier one"
