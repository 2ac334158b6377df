"""What an exported policy says of its robot: its numbers' names, units and ranges, the joints'
order, its code.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from farm import archives
from farm.errors import ConfigError, brief
from farm.sim import quantities
from farm.sim.channels import Quantity
from farm.tasks.actions.numbers import described
from farm.tasks.base import Task
from learner.tools.replay.loaded import LoadedPolicy

_NAMES: Final = ("task", "policy", "generation", "control_period")


def interface(policy: LoadedPolicy) -> dict[str, Any]:
    """Describe a policy's numbers as data for JSON; None where a range is unknown."""
    problem, constants = policy.problem, policy.problem.policy.constants
    task, model, spec = problem.task, problem.task.model, problem.spec
    mean = constants.get("observation_mean")
    moved = [quantities.moved(model, i) for i in range(model.nu)]
    return {
        "observations": _rows(_observations(task, spec.observation)),
        "actions": _rows(described(task, spec.action)),
        "controls": [
            row | {"moves": name}
            for row, name in zip(_rows(quantities.controls(model)), moved, strict=True)
        ],
        "joints": quantities.joints(model),
        "normaliser": (
            None
            if mean is None
            else {"mean": mean.tolist(), "deviation": constants["observation_deviation"].tolist()}
        ),
        "code": problem.code,
    }


def _observations(task: Task, count: int) -> tuple[Quantity, ...]:
    """Observations that a task names, with what its action space adds; else states, or numbers."""
    described = task.observations
    if not described and type(task).observe is Task.observe:
        described = quantities.states(task.model)
    if described and task.space:
        described = task.space.names(described)
    return described or tuple(Quantity(f"observation {i}") for i in range(count))


def _rows(quantities: Sequence[Quantity]) -> list[dict[str, Any]]:
    """Quantities as data."""
    bounds = [
        [value if math.isfinite(value) else None for value in (each.low, each.high)]
        for each in quantities
    ]
    return [
        {"name": each.name, "unit": each.unit, "low": low, "high": high}
        for each, (low, high) in zip(quantities, bounds, strict=True)
    ]


def lines(path: Path, of: Mapping[str, Any]) -> list[str]:
    """What an exported policy says of itself, for people.

    Args:
      path: where it is.
      of: texts and numbers by name, with the interface as JSON.

    Raises:
      ConfigError: it says nothing of its interface, or it is damaged.
    """
    if not all(name in of for name in (*_NAMES, "interface")):
        raise ConfigError(
            f"{path} does not name its numbers: it is no file of this release's farm export"
        )
    try:
        return list(_lines(of))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        reason = brief(f"{type(error).__name__}: {error}")
        raise ConfigError(
            f"{path} is damaged: it does not name its numbers as farm export does ({reason})"
        ) from None


def _lines(of: Mapping[str, Any]) -> Iterator[str]:
    data = json.loads(str(of["interface"]))
    period = f"{float(of['control_period']):g} s"
    yield (
        f"{of['policy']} for {of['task']} after generation {of['generation']}; a control step takes"
        f" {period}"
    )
    for what in ("observations", "actions", "controls", "joints"):
        rows = [_row(i, each) for i, each in enumerate(data[what])]
        widths = [max(len(row[column]) for row in rows) for column in range(4)] if rows else []
        yield f"{what}: {len(rows)}"
        for row in rows:
            yield "  ".join(
                ["", *(f"{text:<{width}}" for text, width in zip(row, widths, strict=True))]
            ).rstrip()
    yield "normaliser: " + (
        "none" if data["normaliser"] is None else "mean and deviation of each observation"
    )
    yield "code: " + ", ".join(f"{name} {digest[:16]}" for name, digest in data["code"].items())


def _row(i: int, of: Mapping[str, Any]) -> tuple[str, str, str, str]:
    low, high = (
        end if of[name] is None else f"{of[name]:g}"
        for name, end in (("low", "-inf"), ("high", "inf"))
    )
    more = {"moves": "moves ", "kind": ""}
    last = next((f"{word}{of[name]}" for name, word in more.items() if of.get(name)), "")
    bounds = "any" if (low, high) == ("-inf", "inf") else f"{low} to {high}"
    return f"{i} {of['name']}", of["unit"] and f"[{of['unit']}]", bounds, last


def of_run(policy: LoadedPolicy) -> dict[str, Any]:
    """Texts and numbers of a run's policy."""
    config = policy.problem.config
    return {
        "task": config.task.rpartition("/")[2],
        "policy": config.policy.rpartition("/")[2],
        "generation": policy.generation,
        "control_period": policy.problem.spec.period,
        "interface": json.dumps(interface(policy)),
    }


def of_npz(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Texts and numbers in an .npz, and lines about its arrays.

    Raises:
      ConfigError: it cannot be read.
    """
    what = ".npz of farm export"
    shapes = {
        name: header.shape for name, header in archives.headers(path, what).items() if header.shape
    }
    return archives.scalars(path, what), [
        f"arrays: {', '.join(f'{name} {shape}' for name, shape in shapes.items())}"
    ]
