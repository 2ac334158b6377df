"""Exports a learnt policy as an ONNX model: observation in, action out, and a memory both ways; see docs/export.md.

Double precision throughout, with the operators of opset 17. The runtime computes sums and functions, so that the last
bits differ from the farm's.
"""

import json
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import settings
from farm.arrays import AnyArray
from farm.errors import ConfigError, writing
from learner.again.replay import LoadedPolicy
from learner.run import checkpoint

OPSET: Final = 17
"""Version of the operators."""
IR: Final = 8
"""Version of the file's format for these operators."""


class Graph:
    """Operators one after another; each value is known by its name, and N is the size of a batch."""

    def __init__(self) -> None:
        """Begin empty.

        Raises:
          ConfigError: onnx is not installed.
        """
        try:
            import onnx
        except ImportError:
            raise ConfigError("an .onnx file needs onnx: pip install onnx") from None
        self._onnx: Any = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def put(self, operator: str, *values: str | AnyArray | float, to: str = "", **attributes: Any) -> str:  # noqa: ANN401
        """Apply an operator to values by name, or to constants; returns the name of the result."""
        names = [value if isinstance(value, str) else self._constant(value) for value in values]
        out = to or f"v{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, names, [out], **attributes))
        return out

    def _constant(self, value: AnyArray | float) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(self._onnx.numpy_helper.from_array(np.array(value), name))
        return name

    def model(self, inputs: Mapping[str, int], outputs: Mapping[str, int], properties: Mapping[str, str]) -> bytes:
        """The file: from inputs to outputs, each (N, size) by its name."""
        helper, double = self._onnx.helper, self._onnx.TensorProto.DOUBLE
        ends = [
            [helper.make_tensor_value_info(name, double, ["N", size]) for name, size in each.items()]
            for each in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "policy", *ends, self._constants)
        operators = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=operators, ir_version=IR, producer_name="rolloutfarm")
        helper.set_model_props(model, dict(properties))
        self._onnx.checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content


def contents(policy: LoadedPolicy) -> bytes:
    """The file.

    Raises:
      ConfigError: onnx is not installed, or the policy is not a built-in one.
    """
    problem, graph = policy.problem, Graph()
    config, constants = problem.config, problem.policy.constants
    if config.policy not in _FORMS:
        raise ConfigError(f"policy {config.policy} has no form in ONNX; these have: {', '.join(_FORMS)}")
    x = "observation"
    if "observation_mean" in constants:
        x = graph.put("Sub", x, constants["observation_mean"])
        x = graph.put("Div", x, constants["observation_deviation"])
    out = _FORMS[config.policy](graph, policy, x)
    graph.put("Identity", out, to="action")
    first = problem.policy.memory
    memories = ({}, {}) if first is None else ({"memory": len(first)}, {"next_memory": len(first)})
    return graph.model(
        {"observation": problem.spec.observation, **memories[0]},
        {"action": problem.spec.action, **memories[1]},
        {
            "task": config.task.rpartition("/")[2],
            "policy": config.policy,
            "generation": str(policy.generation),
            "control_period": repr(problem.spec.period),
            "task_config": json.dumps(settings.to_dict(config.task_config)),
            "policy_config": json.dumps(settings.to_dict(config.policy_config)),
            **({} if first is None else {"memory": json.dumps(first.tolist())}),
        },
    )


def write(path: Path, policy: LoadedPolicy) -> None:
    """Write the file, or leave an existing one.

    Raises:
      ConfigError: onnx is not installed, or the policy is not a built-in one.
      RunError: it cannot be written.
    """
    content = contents(policy)
    with writing(path):
        checkpoint.replace(path, content)


def _layers(graph: Graph, policy: LoadedPolicy, x: str, layers: tuple[int, ...] = (), memory: int = 0) -> str:
    """Networks: `linear`, `mlp`, and `rnn`, whose hidden layer is its next memory."""
    spec, config = policy.problem.spec, policy.problem.config.policy_config
    sizes = (spec.observation + memory, *getattr(config, "layers", layers), spec.action)
    bias: bool = getattr(config, "bias", True)
    first = 0
    for layer, (inputs, units) in enumerate(pairwise(sizes)):
        if layer:
            x = graph.put("Tanh", x, to="next_memory" if memory else "")
        end = first + units * (inputs + bias)
        rows, first = policy.parameters[first:end].reshape(units, inputs + bias), end
        x = graph.put("MatMul", x, rows[:, :inputs].T.copy())
        if bias:
            x = graph.put("Add", x, rows[:, -1])
    return x


def _rnn(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    units: int = policy.problem.config.policy_config.units  # type: ignore[attr-defined]
    return _layers(graph, policy, graph.put("Concat", x, "memory", axis=1), (units,), units)


def _cpg(graph: Graph, policy: LoadedPolicy, x: str) -> str:  # noqa: ARG001
    frequency, amplitude, shift, offset = policy.parameters.reshape(-1, 4).T.copy()
    turns = graph.put("Add", "memory", frequency * policy.problem.spec.period)
    graph.put("Sub", turns, graph.put("Floor", turns), to="next_memory")
    angle = graph.put("Add", graph.put("Mul", "memory", 2.0 * np.pi), shift)
    return graph.put("Add", graph.put("Mul", graph.put("Sin", angle), amplitude), offset)


def _constant(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    return graph.put(
        "Add",
        graph.put("MatMul", x, np.zeros((policy.problem.spec.observation, len(policy.parameters)))),
        policy.parameters,
    )


def _gaussians(graph: Graph, x: str, centres: AnyArray, bandwidth: float) -> str:
    """exp(-|c - x|^2 / (2 h^2)) of centres (K, d), (N, K)."""
    difference = graph.put("Sub", graph.put("Unsqueeze", x, np.array([1])), centres)
    squares = graph.put("ReduceSum", graph.put("Mul", difference, difference), np.array([2]), keepdims=0)
    return graph.put("Exp", graph.put("Mul", squares, -0.5 / bandwidth**2))


def _kernel(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    config: Any = policy.problem.config.policy_config
    return _gaussians(graph, x, policy.parameters.reshape(policy.problem.spec.action, -1), config.bandwidth)


def _rbf(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    spec, config = policy.problem.spec, policy.problem.config.policy_config
    centres, weights = np.split(policy.parameters, [config.centres * spec.observation])  # type: ignore[attr-defined]
    values = _gaussians(graph, x, centres.reshape(-1, spec.observation), config.bandwidth)  # type: ignore[attr-defined]
    return graph.put("MatMul", values, weights.reshape(spec.action, -1).T.copy())


def _weighted_kernel(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    spec, config = policy.problem.spec, policy.problem.config.policy_config
    constants, rows = policy.problem.policy.constants, policy.parameters.reshape(spec.action, -1)
    y = graph.put("Div", graph.put("Sub", x, constants["origin"]), constants["spread"])
    bandwidth = config.width * float(np.sqrt(spec.observation))  # type: ignore[attr-defined]
    values = _gaussians(graph, y, rows[:, :-1].copy(), bandwidth)
    return graph.put("Mul", values, config.weight_scale * rows[:, -1])  # type: ignore[attr-defined]


def _features(graph: Graph, policy: LoadedPolicy, x: str) -> str:
    """Random features: `direct`, and policies that can be converted to it."""
    found, config = policy.problem.policy, policy.problem.config.policy_config
    rows = (found.constants["frequencies"] / config.bandwidth).T.copy()  # type: ignore[attr-defined]
    weights = found.prepare(policy.parameters[None])[0]
    angle = graph.put("Add", graph.put("MatMul", x, rows), found.constants["phases"])
    return graph.put("MatMul", graph.put("Cos", angle), np.sqrt(2.0 / len(rows.T)) * weights.T)


_FORMS: Final[Mapping[str, Callable[[Graph, LoadedPolicy, str], str]]] = {
    "direct": _features, "projected": _features, "cosine": _features, "kernel": _kernel, "linear": _layers,
    "mlp": _layers, "constant": _constant, "rbf": _rbf, "weighted-kernel": _weighted_kernel,
    "rnn": _rnn, "cpg": _cpg,
}  # fmt: skip
