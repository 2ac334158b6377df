"""`farm check`: finds errors of a task in seconds."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from farm import plugins, rollouts, seeds, settings
from farm.arrays import FloatArray
from farm.commands.logs import say
from farm.commands.screen import draw_offscreen
from farm.errors import ConfigError, RunError, TaskError
from farm.rollouts import Runner
from farm.tasks.base import TaskConfig
from learner import config as configs
from learner.commands.replay import ReplayCommand
from learner.commands.run import RunCommand
from learner.config import RunConfig

if TYPE_CHECKING:
    from farm.tasks.loop import Rollouts
    from learner.setup import Problem

ROWS = 8
"""Number of rollouts that are compared."""


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Checks a task: sizes, bounds, the same bits in any batch, rollouts per second, a picture."""

    name: tyro.conf.Positional[str]
    """The task: a name, gym:NAME, or FILE.py:CLASS."""
    picture: Path | None = None
    """Where to write the picture of the start, NAME.png; by default the task's name."""
    backend: str = "cpu"
    """Backend that is compared with cpu, in returns and rollouts per second: a name, or FILE.py:CLASS."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the task."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    name = _name(words)
    own = None if name is None else configs.configure(plugins.find("tasks", name).name)
    default = CheckCommand(name=tyro.MISSING, task=own.task_config if own else TaskConfig())
    command = settings.parse(CheckCommand, words, "farm check", default)
    assert own is not None
    settings.distinct(RunCommand(run=own), "farm run")
    settings.distinct(ReplayCommand(run=Path(), task=own.task_config), "farm replay")
    for line in checked(replace(own, task_config=command.task), command.picture, command.backend):
        say(line)
    return 0


def _name(words: Sequence[str]) -> str | None:
    """The task among the words: the first that looks like one, else the first that is not a flag."""
    loose = [word for word in words if not word.startswith("-")]
    named = [word for word in loose if ":" in word or word in plugins.names("tasks")]
    return next(iter(named or loose), None)


def checked(config: RunConfig, picture: Path | None, backend: str = "cpu") -> Iterator[str]:
    """Yield lines about a task; a TaskError if rollouts depend on their batch."""
    from learner.setup import problem

    other = None if backend == "cpu" else rollouts.backend(backend)
    found = problem(config)
    spec, model = found.spec, found.task.model
    low, high = found.task.limits
    yield f"observation {spec.observation}, actions {spec.action}, controls {model.nu} from {low} to {high}"
    yield f"{spec.steps} control steps of {spec.period:g} s; reward of {', '.join(spec.terms)}"
    channels = ", ".join(channel.name for channel in spec.channels)
    yield f"success: {'yes' if spec.success else 'none'}; channels: {channels or 'none'}"
    yield f"policy {config.policy} with {found.policy.size} parameters"
    runner = found.runner()
    theta = np.random.default_rng(0).normal(0.0, 0.5, (ROWS, found.policy.size))
    drawn = [None if i == 0 else seeds.trial(0, i // 2) for i in range(ROWS)]
    together = runner.rollouts(theta, drawn)
    least, most = together.returns.min(), together.returns.max()
    yield f"returns {least:.4g} to {most:.4g}, {int(together.ended.sum())} ended early"
    if together.failed.any():
        yield f"warning: the simulation of {int(together.failed.sum())} of {ROWS} rollouts became unstable"
    order = np.random.default_rng(1).permutation(ROWS)
    permuted = runner.rollouts(theta[order], [drawn[i] for i in order])
    _same(_arrays(together), {k: v[np.argsort(order)] for k, v in _arrays(permuted).items()}, "in another order")
    for row in range(ROWS):
        alone = runner.rollouts(theta[row : row + 1], [drawn[row]])
        _same({k: v[row] for k, v in _arrays(together).items()}, {k: v[0] for k, v in _arrays(alone).items()}, "alone")
    runner.trajectory(together, 0)
    yield "same bits together, in another order, and one by one"
    yield f"{_speed(runner, theta, drawn):.0f} rollouts/s on one core"
    if other is not None:
        compared = Runner(found.task, found.policy, other.engine, exact=rollouts.exact(other))
        most = np.abs(compared.rollouts(theta, drawn).returns - together.returns).max()
        if most and rollouts.exact(other):
            raise TaskError(f"returns on backend {backend} differ by up to {most:.3g}: its class needs exact = False")
        speed = _speed(compared, theta, drawn)
        yield f"backend {backend}: returns differ by at most {most:.3g}; {speed:.0f} rollouts/s"
    yield _picture(found, together.start["qpos"][0], picture)


def _speed(runner: Runner, theta: FloatArray, drawn: list[tuple[int, ...] | None]) -> float:
    """Rollouts per second of a batch four times as large."""
    begun, many = time.perf_counter(), np.tile(theta, (4, 1))
    runner.rollouts(many, drawn * 4)
    return len(many) / (time.perf_counter() - begun)


def _arrays(of: "Rollouts") -> dict[str, FloatArray]:
    """Everything that must not depend on the batch, the earliest cause first."""
    out = {f"{name} at the start": values for name, values in of.start.items()}
    out |= {"actions": of.actions, **of.frames}
    return out | {name: getattr(of, name) for name in ("terms", "returns", "success", "ended")}


def _same(first: dict[str, FloatArray], second: dict[str, FloatArray], how: str) -> None:
    """Compare arrays bit for bit."""
    for name, values in first.items():
        if values.tobytes() != np.ascontiguousarray(second[name]).tobytes():
            most = np.abs(np.asarray(values, float) - np.asarray(second[name], float)).max()
            raise TaskError(
                f"{name} differs (by up to {most:.3g}) when the same rollouts run {how}: rows of a batch must not "
                "depend on each other, and the task object must not remember anything of a rollout"
            )


def _picture(found: "Problem", qpos: FloatArray, path: Path | None) -> str:
    """Draw the start; returns a line with the file's name."""
    from farm.sim import rendering

    target = path or Path(f"{type(found.task).__name__.lower()}.png")
    if target.suffix != ".png":
        raise ConfigError(f"--picture {target}: expected a name that ends in .png")
    try:
        from PIL import Image
    except ImportError:
        return "no picture: it needs pillow (pip install pillow)"
    try:
        [drawn] = rendering.pictures(found.task.model, qpos[None], (480, 360), camera=found.task.camera)
        Image.fromarray(drawn).save(target)
    except (RunError, OSError) as error:
        return f"no picture: {error}"
    return f"the start: {target}"
