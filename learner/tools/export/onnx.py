"""Exports a learnt policy as an ONNX model: observation in, action out, and a memory both ways; see
docs/export.md.

Double precision throughout, with the operators of opset 17. The runtime computes sums and
functions, so that the last bits differ from the farm's. `Policy.onnx` says what a policy computes;
here it is compared with `Policy.act`.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import plugins, settings
from farm.arrays import AnyArray, FloatArray
from farm.errors import ConfigError, FarmError, brief, writing
from farm.tasks.standard import observed
from learner.run import checkpoint
from learner.tools.export.interface import interface
from learner.tools.replay.loaded import LoadedPolicy

OPSET: Final = 17
"""Version of the operators."""
IR: Final = 8
"""Version of the file's format for these operators."""

_STATES: Final = 1000  # on which both are compared
_OBSERVATIONS: Final = 200  # observations around which these are drawn, about
_TURNS: Final = 3  # in which a policy with memory acts on each of them
_NOISE: Final = 0.1  # added to observations, in their standard deviations
# Largest difference, relative where actions are above 1; by the policy's own precision
_DOUBLE, _SINGLE = (1e-9, 1e-4)
_NUMBERS: Final = 4_000_000  # of parameters in one call of the policy


def library() -> Any:  # noqa: ANN401  a module
    """The package onnx; a ConfigError if it is not installed."""
    try:
        import onnx
        import onnx.reference
    except ImportError:
        raise ConfigError("an .onnx file needs onnx: pip install onnx") from None
    return onnx


class OnnxGraph:
    """Operators one after another.

    Each value is known by its name, and N is the size of a batch.
    """

    def __init__(self) -> None:
        """Begin empty; a ConfigError if onnx is not installed."""
        self._onnx = library()
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def put(
        self,
        operator: str,
        *values: str | AnyArray | float,
        to: str = "",
        **attributes: Any,  # noqa: ANN401
    ) -> str:
        """Apply an operator to values by name, or to constants; returns the name of the result."""
        names = [value if isinstance(value, str) else self._constant(value) for value in values]
        out = to or f"v{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, names, [out], **attributes))
        return out

    def _constant(self, value: AnyArray | float) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(self._onnx.numpy_helper.from_array(np.array(value), name))
        return name

    def model(
        self, inputs: Mapping[str, int], outputs: Mapping[str, int], properties: Mapping[str, str]
    ) -> bytes:
        """The file: from inputs to outputs, each (N, size) by its name."""
        helper, double = self._onnx.helper, self._onnx.TensorProto.DOUBLE
        ends = [
            [
                helper.make_tensor_value_info(name, double, ["N", size])
                for name, size in each.items()
            ]
            for each in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "policy", *ends, self._constants)
        operators = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(
            graph, opset_imports=operators, ir_version=IR, producer_name="rolloutfarm"
        )
        helper.set_model_props(model, dict(properties))
        self._onnx.checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content


def contents(policy: LoadedPolicy) -> bytes:
    """The file.

    Raises:
      ConfigError: onnx is not installed, or the policy has no form in ONNX, or one that acts
          differently.
    """
    problem = policy.problem
    config, first = problem.config, problem.policy.memory
    memories = ({}, {}) if first is None else ({"memory": len(first)}, {"next_memory": len(first)})
    graph = _graph(policy)
    try:
        content = graph.model(
            {"observation": problem.spec.observation, **memories[0]},
            {"action": problem.spec.action, **memories[1]},
            {
                "task": config.task.rpartition("/")[2],
                "policy": config.policy.rpartition("/")[2],
                "generation": str(policy.generation),
                "control_period": repr(problem.spec.period),
                "task_config": json.dumps(settings.to_dict(config.task_config)),
                "policy_config": json.dumps(settings.to_dict(config.policy_config)),
                "interface": json.dumps(interface(policy)),
                **({} if first is None else {"memory": json.dumps(first.tolist())}),
            },
        )
        _compare(policy, content)
    except FarmError:
        raise
    # The package onnx has many kinds of errors, and a policy of one's own may cause any
    except Exception as error:
        raise ConfigError(f"onnx of {config.policy} makes no model: {brief(str(error))}") from None
    return content


def listed(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The properties of an .onnx, and lines about what goes in and comes out.

    Raises:
      ConfigError: onnx is not installed, or it cannot be read.
    """
    onnx = library()
    try:
        model = onnx.load(path, load_external_data=False)  # which may be any file
        ends = {"takes": model.graph.input, "gives": model.graph.output}
        sizes = {
            word: [
                f"{each.name} (N, {each.type.tensor_type.shape.dim[1].dim_value})"
                for each in ends[word]
            ]
            for word in ends
        }
    except Exception as error:  # protobuf's errors have no common class
        raise ConfigError(f"{path} is no ONNX model of farm export: {brief(str(error))}") from None
    properties = {each.key: each.value for each in model.metadata_props}
    return properties, [f"{word} {', '.join(each)}" for word, each in sizes.items()]


def write(path: Path, policy: LoadedPolicy) -> None:
    """Write the file, or leave an existing one.

    Raises:
      ConfigError: onnx is not installed, or the policy has no form in ONNX, or one that acts
          differently.
      RunError: it cannot be written.
    """
    content = contents(policy)
    with writing(path):
        checkpoint.replace(path, content)


@plugins.no_exit
def _graph(policy: LoadedPolicy) -> OnnxGraph:
    """What the policy puts."""
    actor, graph, name = policy.problem.policy, OnnxGraph(), policy.problem.config.policy
    try:
        result: object = actor.onnx(
            graph, policy.parameters, "observation", "" if actor.memory is None else "memory"
        )
    except NotImplementedError:
        raise ConfigError(
            f"policy {name} has no form in ONNX: give it a method onnx(self, graph, theta, x,"
            " memory)"
        ) from None
    names = (result,) if actor.memory is None else result
    ends = ("action",) if actor.memory is None else ("action", "next_memory")
    if (
        not isinstance(names, tuple)
        or len(names) != len(ends)
        or not all(isinstance(each, str) for each in names)
    ):
        raise ConfigError(
            f"onnx of {name} gave {result!r:.60}; expected the name of {' and that of '.join(ends)}"
        )
    for each, end in zip(names, ends, strict=True):
        graph.put("Identity", str(each), to=end)
    return graph


def _compare(policy: LoadedPolicy, content: bytes) -> None:
    """Compare both on states of the task, in a few turns if there is a memory.

    Raises:
      ConfigError: an action or memory differs.
    """
    actor, name, rng = policy.problem.policy, policy.problem.config.policy, np.random.default_rng(0)
    session = library().reference.ReferenceEvaluator(content)
    observations = observed(policy.problem.task, _OBSERVATIONS)
    first, turns = (np.zeros(0), 1) if actor.memory is None else (actor.memory, _TURNS)
    allowed = _SINGLE if actor.prepare(policy.parameters[None]).dtype == np.float32 else _DOUBLE
    at_once = max(1, min(_STATES, _NUMBERS // actor.size))
    for start in range(0, _STATES, at_once):
        count = min(at_once, _STATES - start)
        acting, memory = policy.acting(count), np.tile(first, (count, 1))
        for _ in range(turns):
            x = observations[rng.integers(len(observations), size=count)]
            x = x + _NOISE * observations.std(axis=0) * rng.standard_normal(x.shape)
            outputs: list[FloatArray] = session.run(
                None, {"observation": x, **({"memory": memory} if first.size else {})}
            )
            reference = np.asarray(acting.act(x), dtype=float)
            _same(name, outputs[0], reference, start, allowed)
            if first.size:
                memory = outputs[1]


def _same(name: str, output: FloatArray, reference: FloatArray, start: int, allowed: float) -> None:
    if output.shape != reference.shape:
        raise ConfigError(
            f"onnx of {name} gives actions of shape {output.shape}; expected {reference.shape},"
            " as act"
        )
    most = allowed * np.maximum(1.0, np.abs(reference))
    with np.errstate(invalid="ignore"):
        alike = (np.abs(output - reference) <= most) | (output == reference)
    differs = ~(alike | (np.isnan(output) & np.isnan(reference)))
    if differs.any():
        row, column = np.argwhere(differs)[0].tolist()
        raise ConfigError(
            f"onnx of {name} gives action {column} as {output[row, column]:.9g} in state"
            f" {start + row} of {_STATES}; act gives {reference[row, column]:.9g}"
        )
