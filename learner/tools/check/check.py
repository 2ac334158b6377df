"""Finds errors of a task in seconds, from Python; what `farm check` does.

import farm

for line in farm.check("pendulum.py:Pendulum"):
    print(line)
"""

import difflib
import hashlib
import inspect
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from farm import command_line, seeds
from farm.arrays import FloatArray
from farm.commands.logs import say
from farm.errors import ConfigError, RunError, TaskError, UnstableError
from farm.replacing import replacing
from farm.returns import known
from farm.tasks.base import Task
from learner import algorithms
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.tools.replay.command import ReplayCommand

if TYPE_CHECKING:
    from farm.runner import Runner
    from farm.tasks.rollouts import Rollouts
    from learner.run.setup import Problem

ROWS = 8
"""Number of rollouts that are compared."""

_STILL: Final = 1e-6  # a change of an action that counts as none
_GROUPS: Final = 31  # of actuators that a model can disable
_LIKE: Final = 0.8  # similarity of names, 1 if equal
_AGAIN: Final = (
    "import sys; from farm import plugins;"
    " plugins.load('learner.tools.check.check').again(sys.stdin.read())"
)


def check(
    task: str | RunConfig,
    *,
    backend: str = "cpu",
    picture: str | Path | None = None,
    said: Callable[[str], object] | None = None,
    **changed: Any,  # noqa: ANN401  any setting of a run
) -> list[str]:
    """Check a task: its sizes and bounds, whether rollouts have the same bits in any batch and in
    another process, and how fast they are.

    Args:
      task: a name, gym:NAME, FILE.py:CLASS, or a run of the task.
      backend: what is compared with `cpu`, in returns and rollouts per second.
      picture: where to write a picture of the start, NAME.png; None: none is written.
      said: called with each line as soon as it is known.
      changed: settings of the task and of the policy that acts, as in `farm.configure`.

    Returns:
      What there is to say, a line each; those of something odd begin with `warning: `.

    Raises:
      ConfigError: there is no such task, or a setting is unknown or invalid.
      TaskError: rollouts depend on their batch or process, or all fail.

    Example:
      ```python
      import farm

      lines = farm.check("finger-gait", friction=0.5, policy="linear")
      assert not [line for line in lines if line.startswith("warning")]
      ```
    """
    config = (
        configs.changed_by(task, changed)
        if isinstance(task, RunConfig)
        else configs.configure(task, **changed)
    )
    lines = []
    for line in _checked(config, None if picture is None else Path(picture), backend):
        lines.append(line)
        if said is not None:
            said(line)
    return lines


def _checked(config: RunConfig, picture: Path | None, backend: str) -> Iterator[str]:
    """Yield lines about a task; a TaskError if rollouts depend on their batch or process.

    Args:
      config: a run of the task.
      picture: where to write one; None: none is written.
      backend: compared with cpu.
    """
    from learner.commands.run import RunCommand  # imports MuJoCo

    if picture is not None and picture.suffix != ".png":
        raise ConfigError(f"--picture {picture}: expected a name that ends in .png")
    command_line.distinct(RunCommand(run=config), "farm run")
    command_line.distinct(ReplayCommand(run=Path(), task=config.task_config), "farm replay")
    from farm.runner import Runner, is_exact, make_backend
    from learner.run import setup

    other = None if backend == "cpu" else make_backend(backend)
    problem = setup.problem(config)
    spec = problem.spec
    low, high = problem.task.limits
    bounds = f" from {low} to {high}" if len(low) else ""
    yield f"observation {spec.observation}, actions {spec.action}, controls {len(low)}{bounds}"
    terms = "" if spec.terms == ("reward",) else f"; reward of {', '.join(spec.terms)}"
    yield f"{spec.steps} control steps of {spec.period:g} s{terms}"
    channels = ", ".join(channel.name for channel in spec.channels)
    yield f"success: {'yes' if spec.success else 'none'}; channels: {channels or 'none'}"
    yield f"policy {config.policy} with {problem.policy.size} parameters"
    runner = problem.runner()
    theta, starts = batch(problem)
    together = runner.rollouts(theta, starts)
    yield from _returns(together)
    yield from _failures(config, runner, theta, starts, together)
    warnings = (
        *odd(together),
        *_disabled(problem.task),
        *_still(problem, runner),
        *unread(type(problem.task)),
    )
    yield from (f"warning: {each}" for each in warnings)
    order = np.random.default_rng(1).permutation(ROWS)
    permuted = runner.rollouts(theta[order], [starts[i] for i in order])
    _same(
        _arrays(together),
        {k: v[np.argsort(order)] for k, v in _arrays(permuted).items()},
        "in another order",
    )
    for row in range(ROWS):
        alone = runner.rollouts(theta[row : row + 1], [starts[row]])
        _same(
            {k: v[row] for k, v in _arrays(together).items()},
            {k: v[0] for k, v in _arrays(alone).items()},
            "alone",
        )
    runner.trajectory(together, 0)
    digests, others = _digests(together), _elsewhere(config)
    for name in (name for name, digest in digests.items() if others.get(name) != digest):
        raise TaskError(
            f"{name} differs when the same rollouts run in another process: numbers must not depend"
            " on what a process draws or reads for itself, such as random.random(), hash() or the"
            " time"
        )
    yield "same bits together, in another order, one by one, and in another process"
    yield f"{_speed(runner, theta, starts):.0f} rollouts/s on one core"
    if other is not None:
        compared = Runner(problem.task, problem.policy, other.engine, exact=is_exact(other))
        most = np.abs(compared.rollouts(theta, starts).returns - together.returns).max()
        if most and is_exact(other):
            raise TaskError(
                f"returns on backend {backend} differ by up to {most:.3g}: its class needs exact ="
                " False"
            )
        speed = _speed(compared, theta, starts)
        yield f"backend {backend}: returns differ by at most {most:.3g}; {speed:.0f} rollouts/s"
    if picture is not None:
        yield _picture(
            problem, {name: values[:1] for name, values in together.start.items()}, picture
        )


def again(run: str) -> None:
    """Print digests of the rollouts that a check of a run simulates, as JSON, for `_elsewhere`.

    Args:
      run: its configuration, as JSON.
    """
    with redirect_stdout(sys.stderr):  # the task's file may print
        from learner.run import setup

        problem = setup.problem(configs.from_dict(json.loads(run), "farm check"))
        text = json.dumps(_digests(problem.runner().rollouts(*batch(problem))))
    say(text)


def _elsewhere(config: RunConfig) -> dict[str, str]:
    """Digests of this run's rollouts from a new process, with its own random numbers and hashes."""
    command = [sys.executable, "-P", "-c", _AGAIN]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONHASHSEED"}
    run = json.dumps(configs.to_dict(config))
    process = subprocess.run(
        command, input=run, capture_output=True, env=environment, encoding="utf-8", check=False
    )
    if process.returncode:
        why = process.stderr.strip().splitlines()[-1:]
        raise TaskError(f"the same rollouts cannot be simulated in another process: {''.join(why)}")
    digests: dict[str, str] = json.loads(process.stdout.splitlines()[0])
    return digests


def batch(problem: "Problem") -> tuple[FloatArray, list[tuple[int, ...] | None]]:
    """Parameters (ROWS, P) and seeds of the rollouts that are compared."""
    theta = np.random.default_rng(0).normal(0.0, 0.5, (ROWS, problem.policy.size))
    return theta, [None if i == 0 else seeds.evaluation_start(0, i // 2) for i in range(ROWS)]


def _returns(rollouts: "Rollouts") -> Iterator[str]:
    """The returns that there are."""
    values = rollouts.returns[known(rollouts.returns)]
    if values.size:
        yield (
            f"returns {values.min():.4g} to {values.max():.4g}, {int(rollouts.ended.sum())} ended"
            " early"
        )


def _failures(
    config: RunConfig,
    runner: "Runner",
    theta: FloatArray,
    starts: list[tuple[int, ...] | None],
    rollouts: "Rollouts",
) -> Iterator[str]:
    """Warnings about rollouts that failed, with what is known of the causes, and about MuJoCo's own
    warnings.

    Raises:
      TaskError: all failed.
    """
    from farm.runner import told
    from farm.sim.complaints import explained
    from learner.run.instability import causes

    for kind, warned in runner.trouble.warned.items():
        yield f"warning: in {warned} of {ROWS} rollouts {explained(kind)}"
    count, errors = int(rollouts.failed.sum()), runner.trouble.errors
    if not count:
        return
    of_code = [error for error in errors if not isinstance(error, UnstableError)]
    if of_code:
        if count == ROWS:
            raise of_code[0]
        text = told(of_code[0])
        yield f"warning: {count} of {ROWS} rollouts failed, the first with {text['error']}"
        yield from (f"  {line}" for line in text["traceback"])
        return
    yield f"warning: the simulation of {count} of {ROWS} rollouts became unstable:"
    yield from (
        f"  {line}" for line in [*map(str, errors[:1]), *causes(config, theta, starts, rollouts)]
    )
    if count == ROWS:
        raise TaskError(
            f"all {ROWS} rollouts became unstable, so that nothing can be learnt: see above"
        )


def odd(rollouts: "Rollouts") -> Iterator[str]:
    """What rollouts of a finished task hardly ever do."""
    wild = int((~np.isfinite(rollouts.actions)).any(axis=(1, 2)).sum())
    if wild:
        yield f"act of the policy is not finite in {wild} of {ROWS} rollouts"
    count = int(rollouts.failed.sum())
    if (rollouts.ended & (rollouts.steps == 1)).all():
        yield "every rollout ends in its first control step; is `ended` what you mean?"
    elif not count and len(set(rollouts.returns.tolist())) == 1:
        yield f"all {ROWS} rollouts have the same return, so that there is nothing to learn"


def _disabled(task: Task) -> Iterator[str]:
    """Actuators in groups that the model disables, whose controls do nothing."""
    model = task.model
    names = [
        model.actuator(i).name or str(i)
        for i, group in enumerate(model.actuator_group.tolist())
        if group in range(_GROUPS) and model.opt.disableactuator >> group & 1
    ]
    if names:
        yield f"the model disables actuators, whose controls do nothing: {', '.join(names)}"


def _still(problem: "Problem", runner: "Runner") -> Iterator[str]:
    """Whether none of the first perturbations that a run draws changes an action of its first mean
    policy.
    """
    from farm.policies.fourier import Kernel, Projected

    state, algorithm = problem.begin(), problem.config.algorithm_of()
    eps = algorithms.ask(algorithm, state, seeds.exploration(problem.config.seed, 0))[:ROWS]
    starts: list[tuple[int, ...] | None] = [seeds.evaluation_start(0, i) for i in range(len(eps))]
    mean = runner.rollouts(np.repeat(state.mu[None], len(eps), axis=0), starts).actions
    with np.errstate(invalid="ignore"):
        changes = np.abs(runner.rollouts(state.mu + eps, starts).actions - mean)
    if (changes <= _STILL).all():
        fits = isinstance(problem.policy, Kernel | Projected)
        advice = (
            f"--start fitted{' --no-normalise' if problem.config.policy_config.normalise else ''}"
            if fits
            else "a larger --initial-sigma, or another --policy, such as linear"
        )
        yield (
            f"no perturbation changes any action: {len(eps)} of sigma {state.sigma.mean():.3g}"
            f" change those of policy {problem.config.policy} by at most {changes.max():.1g}, so"
            f" that a run learns nothing; try {advice}"
        )


def unread(task: type[Task]) -> Iterator[str]:
    """Attributes of a task's own classes that nothing reads, with names like those that a task
    has.
    """
    names = [name for name in dir(Task) if not name.startswith("_")]
    classes = task.__mro__[: task.__mro__.index(Task)]
    source = "\n".join(map(_source, classes))  # a class may read what a subclass says
    for kind in classes:
        for name in vars(kind):
            like = [] if name in names else difflib.get_close_matches(name, names, 1, _LIKE)
            if like and not re.search(rf"(?<!\bsim)\.{name}\b", source):
                yield f"{kind.__name__}.{name} is not read by anything; is {like[0]} meant?"


def _source(kind: type) -> str:
    try:
        return inspect.getsource(sys.modules[kind.__module__])
    except (OSError, TypeError):  # it has none
        return ""


def _speed(runner: "Runner", theta: FloatArray, starts: list[tuple[int, ...] | None]) -> float:
    """Rollouts per second of a batch four times as large."""
    start, many = time.perf_counter(), np.tile(theta, (4, 1))
    runner.rollouts(many, starts * 4)
    return len(many) / (time.perf_counter() - start)


def _arrays(of: "Rollouts") -> dict[str, FloatArray]:
    """Everything that must not depend on the batch, the earliest cause first."""
    out = {f"{name} at the start": values for name, values in of.start.items()}
    out |= {"actions": of.actions, **of.frames}
    return out | {name: getattr(of, name) for name in ("terms", "returns", "success", "ended")}


def _digests(of: "Rollouts") -> dict[str, str]:
    """SHA-256 of each of these arrays."""
    arrays = {name: np.ascontiguousarray(values) for name, values in _arrays(of).items()}
    return {name: hashlib.sha256(values.tobytes()).hexdigest() for name, values in arrays.items()}


def _same(first: dict[str, FloatArray], second: dict[str, FloatArray], how: str) -> None:
    """Compare arrays bit for bit."""
    for name, values in first.items():
        if values.tobytes() != np.ascontiguousarray(second[name]).tobytes():
            most = np.abs(np.asarray(values, float) - np.asarray(second[name], float)).max()
            raise TaskError(
                f"{name} differs (by up to {most:.3g}) when the same rollouts run {how}: rows of a"
                " batch must not depend on each other, and the task object must not remember"
                " anything of a rollout"
            )


def _picture(problem: "Problem", start: Mapping[str, FloatArray], path: Path) -> str:
    """Draw the start; returns a line with the file's name."""
    from farm.sim import rendering

    try:
        from PIL import Image
    except ImportError:
        return "no picture: it needs pillow (pip install pillow)"
    try:
        task = problem.task
        options = {"channels": problem.task.channels, "values": problem.task.show(start)}
        qpos, mocap = start["qpos"], start.get("mocap")
        [pixels] = rendering.pictures(
            task.model, qpos, (480, 360), camera=task.camera, mocap=mocap, **options
        )
        with replacing(path) as aside:
            Image.fromarray(pixels).save(aside)
    except OSError as error:
        return f"no picture: cannot write {path}: {error.strerror or error}"
    except RunError as error:
        return f"no picture: {error}"
    return f"the start: {path}"
