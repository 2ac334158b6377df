"""What a class says of itself as a task, and what one control step shows: its specification, and
its first mistakes.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final, TypeVar

import mujoco
import numpy as np

from farm.arrays import FloatArray, shaped
from farm.errors import ConfigError, TaskError
from farm.sim import mixed
from farm.sim.channels import Camera, Channel, Measure, Quantity
from farm.sim.engines import BatchEngine
from farm.sim.scene import MODEL, quiet
from farm.sim.sim import Sim
from farm.tasks import disturbances
from farm.tasks.actions import numbers
from farm.tasks.actions.space import ActionSpace
from farm.tasks.base import STEPS_LIMIT, Score, Task, TaskSpec
from farm.tasks.loop import Batch, again, scores
from farm.tasks.robust import SIZES

T = TypeVar("T")

_WORD: Final = re.compile("[A-Za-z][A-Za-z0-9-]*")
_METHODS: Final = (
    *(
        "models",
        "which",
        "setup",
        "prepare",
        "reset",
        "observe",
        "act",
        "reward",
        "ended",
        "success",
        "measure",
    ),
    *("score", "outcomes", "show"),
)


def specification(task: Task) -> TaskSpec:
    """A task's specification: its own, or found by one control step of one nominal rollout.

    Raises:
      ConfigError: the class cannot be a task.
      TaskError: it returns invalid arrays.
    """
    for what in ("observations", "actions"):
        _check_quantities(task, what)
    disturbances.check(task)
    spec = task.spec() or _found(task)
    measures: object = task.measures
    if not isinstance(measures, tuple | list) or not all(
        isinstance(each, Measure) for each in measures
    ):
        raise ConfigError(
            f"task {type(task).__name__}: measures is {measures!r:.60}; expected a tuple of"
            " farm.Measure"
        )
    names = [each.name for each in task.measures]
    if len(set(names)) < len(names):
        raise ConfigError(
            f"task {type(task).__name__}: two measures are named alike: {', '.join(names)}"
        )
    for what, count in (("observations", spec.observation), ("actions", spec.action)):
        _check_count(task, what, count)
    _check_parts(task, spec.observation)
    # With an action space, the first observation checks the sizes
    if task.robust is not None and task.space is None:
        for cause in SIZES:
            task.robust.sizes(cause, spec.observation, task.parts)
    several = (_models(task),) if len(task.simulated) > 1 else ()
    channels = (*spec.channels, *disturbances.channels(task), *several)
    return replace(spec, measures=tuple(task.measures), channels=channels)


def _check_quantities(task: Task, what: str) -> None:
    """Check that an attribute names quantities, if it names any, or says how many numbers an action
    has.
    """
    quantities: object = getattr(task, what)
    if isinstance(quantities, type) and issubclass(quantities, ActionSpace):
        raise ConfigError(
            f"task {type(task).__name__}: {what} is a class; expected an object:"
            f" {quantities.__name__}(...)"
        )
    if what == "actions" and (task.space or numbers.is_size(quantities)):
        return
    if not isinstance(quantities, tuple | list) or not all(
        isinstance(each, Quantity) for each in quantities
    ):
        number = (
            f"a farm.ActionSpace, a number from 1 to {numbers.LIMIT} or "
            if what == "actions"
            else ""
        )
        raise ConfigError(
            f"task {type(task).__name__}: {what} is {quantities!r:.60}; expected {number}a tuple of"
            " farm.Quantity"
        )


def _check_count(task: Task, what: str, count: int) -> None:
    """Check that an attribute names as many numbers as there are, if it names any."""
    quantities = getattr(task, what)
    if task.space:
        quantities = task.space.names(quantities) if quantities and what == "observations" else ()
    size = quantities if isinstance(quantities, int) else len(quantities)
    if size and size != count:
        raise ConfigError(
            f"task {type(task).__name__}: {what} names {size} numbers; there are {count}"
        )


def _check_parts(task: Task, count: int) -> None:
    """Check that the sizes of an observation's parts, if a task names any, add up to its numbers,
    of which an action space may add some.
    """
    parts: object = task.parts
    if not isinstance(parts, tuple | list) or not all(
        isinstance(each, int | np.integer) for each in parts
    ):
        raise ConfigError(
            f"task {type(task).__name__}: parts is {parts!r:.60}; expected a tuple of sizes"
        )
    total = sum(parts)
    if parts and (total > count if task.space else total != count):
        raise ConfigError(
            f"task {type(task).__name__}: parts are {parts}; expected sizes that add up to the"
            f" observation's {count}"
        )


def _models(task: Task) -> Channel:
    """The channel that says which of several models a rollout has."""
    names = mixed.names(task.simulated)
    return Channel(name=MODEL, kind="flags", shape=(len(names),), labels=names)


def tried(task: Task, rollouts: int, look: Callable[[Sim], T]) -> T:
    """Call a function with a simulation of a task, of at most this number of rollouts.

    It is closed afterwards.

    It may be called again: when it reads an output of the simulator for the first time.
    """
    quiet()
    sim = Sim(task.engine(lambda model: BatchEngine(model, rollouts)))

    def begun() -> T:
        task.setup(sim)
        return look(sim)

    try:
        return again(begun)
    finally:
        sim.engine.close()


def _found(task: Task) -> TaskSpec:
    quiet()
    _check_class(task)

    def look(sim: Sim) -> tuple[int, tuple[str, ...], bool]:
        batch = Batch(task, sim, [None])
        x = batch.observe()
        with np.errstate(all="ignore"):
            batch.step(np.zeros((1, task.action_size)))
            _check_channels(task, batch.frames)
            if scores(task):
                return x.shape[1], *_scored(task, batch)
        return x.shape[1], batch.names, type(task).success is not Task.success

    size, names, success = tried(task, 1, look)
    return TaskSpec(
        observation=size,
        action=task.action_size,
        steps=task.steps,
        period=task.period,
        terms=names or ("reward",),
        success=success,
        channels=task.channels,
    )


def _scored(task: Task, batch: Batch) -> tuple[tuple[str, ...], bool]:
    """Names of the reward terms that `score` gives a rollout of one control step, and whether it
    knows success.
    """
    record = replace(batch.record(), steps=np.ones(1, dtype=int))
    score = None
    with suppress(Exception):  # it may want a whole rollout
        score = task.score(record)
    terms = np.shape(score.terms) if isinstance(score, Score) else ()
    count = terms[2] if len(terms) == 3 else 1
    names = ("reward",) if count == 1 else tuple(f"reward_{i + 1}" for i in range(count))
    return names, isinstance(score, Score) and score.success is not None


def _check_class(task: Task) -> None:
    """Check a task's attributes and methods.

    Raises:
      ConfigError: names the first invalid one.
    """
    name = type(task).__name__
    for what, most in (("steps", STEPS_LIMIT), ("substeps", STEPS_LIMIT)):
        value = getattr(task, what)
        if type(value) is not int or not 1 <= value <= most:
            raise ConfigError(
                f"task {name}: {what} is {value!r}; expected a whole number from 1 to {most}"
            )
    if not isinstance(task.ending, str) or not _WORD.fullmatch(task.ending):
        raise ConfigError(
            f"task {name}: ending is {task.ending!r:.60}; expected one word of letters, digits and"
            " dashes, as it is a flag of farm replay"
        )
    if task.camera is not None and not isinstance(task.camera, Camera):
        raise ConfigError(f"task {name}: camera is {task.camera!r}; expected a farm.Camera")
    _check_declared(task)
    numbers.check(task)
    _check_methods(type(task))


def _check_declared(task: Task) -> None:
    """Check the channels that a task names."""
    name = type(task).__name__
    channels: object = task.channels
    if not isinstance(channels, tuple | list) or not all(
        isinstance(each, Channel) for each in channels
    ):
        raise ConfigError(
            f"task {name}: channels is {channels!r:.60}; expected a tuple of farm.Channel"
        )
    names = [each.name for each in task.channels]
    if len(set(names)) < len(names):
        raise ConfigError(f"task {name}: two channels are named alike: {', '.join(names)}")
    kinds = {"geometry": mujoco.mjtObj.mjOBJ_GEOM, "body": mujoco.mjtObj.mjOBJ_BODY}
    for channel in task.channels:
        parts = [("geometry", each) for each in channel.geoms]
        parts += [("body", each) for each in channel.bodies]
        for kind, each in parts:
            if mujoco.mj_name2id(task.model, kinds[kind], each) < 0:
                raise ConfigError(
                    f"task {name}: there is no {kind} {each!r} in the model, which channel"
                    f" {channel.name!r} names"
                )


def _check_methods(kind: type[Task]) -> None:
    """Check that a task's methods can be called as they are."""
    for method in _METHODS:
        if not callable(value := getattr(kind, method)):
            raise ConfigError(
                f"task {kind.__name__}: {method} is {value!r:.60}; expected a method, or leave it"
                " out"
            )
        signature, base = (inspect.signature(getattr(each, method)) for each in (kind, Task))
        try:
            signature.bind(*base.parameters)
        except TypeError:
            raise ConfigError(
                f"task {kind.__name__}: {method}{signature}; expected"
                f" ({', '.join(base.parameters)})"
            ) from None


def _check_channels(task: Task, frames: Mapping[str, FloatArray]) -> None:
    """Check that the task measures its channels.

    Raises:
      TaskError: one is missing or has another shape.
    """
    missing = [c.name for c in task.channels if c.name not in frames]
    if missing and type(task).show is Task.show:
        raise TaskError(
            f"channel {missing[0]!r} is not measured: measure gives {', '.join(frames)}"
        )
    channels = task.show({name: values[:, :1] for name, values in frames.items()})
    if not isinstance(channels, Mapping):
        raise TaskError(f"show gave a {type(channels).__name__}; expected arrays by name")
    for channel in task.channels:
        shaped(f"channel {channel.name!r}", channels.get(channel.name), (1, 1, *channel.shape))
