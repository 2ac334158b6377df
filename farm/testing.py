"""Golden rollouts: a task's rollouts are those in a file, to the last bit; for test suites.

from farm.testing import same

def test_the_pendulum_moves_as_before(golden):
    golden("pendulum.py:Pendulum", "linear", range(3), "pendulum.npz")

The fixture `golden` of pytest comes with the package (`farm/pytest_plugin.py`). It calls `same`
with a file beside the test; `pytest --golden-update` writes the file.
"""

import io
import json
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import __version__, archives, fingerprint, plugins, seeds, settings
from farm.arrays import AnyArray, FloatArray, IntArray
from farm.errors import ConfigError, writing
from farm.replacing import replacing
from farm.runner import build_policy, draw_constants, task_of
from farm.tasks import loop
from farm.tasks.base import Task, TaskSpec
from farm.tasks.loop import Acts
from farm.tasks.probe import specification, tried
from farm.tasks.rollouts import Seed

_MADE: Final = "made"
"""The entry of a file that says what made it, as JSON."""
_ORDER: Final = {"state": 0, "action": 2, "reward": 5}
"""Within a control step, of four: state 1 follows action 0, and reward 0 follows state 1."""


def same(
    task: str | type[Task] | Task,
    policy: Any,  # noqa: ANN401  see below
    starts: Iterable[int | None],
    file: str | Path,
    *,
    update: bool = False,
) -> None:
    """Simulate rollouts, and compare every number with those in a file; B rollouts of at most T
    control steps.

    Args:
      task: its name, FILE.py:CLASS, its class, or an object of it with settings of its own.
      policy: what `farm.load` gives; a function from observations (B, d) to actions (B, A); or the
        name of a policy (FILE.py:CLASS), whose parameters are drawn from a normal distribution with
        standard deviation 0.5.
      starts: their seeds, whole numbers below 2^32; None: the nominal start.
      file: an .npz of numpy.
      update: write the file instead.

    Raises:
      AssertionError: a number is another one; names the first rollout, control step and array, and
          both values.
      ConfigError: the file is missing or no such file, or task, policy or seeds are invalid.
    """
    __tracebackhide__ = True
    path, words = Path(file), [_word(each) for each in starts]
    if not words:
        raise ConfigError("there are no seeds; expected one for each rollout")
    if not update and not path.is_file():
        raise ConfigError(
            f"there is no file {path}: update=True (pytest --golden-update) writes it"
        )
    arrays = _simulated(task_of(task), policy, words)
    origin = {
        "seeds": [None if word is None else word[2] for word in words],
        "rolloutfarm": __version__,
        "mujoco": version("mujoco"),
        "numbers": fingerprint.digest()[:8],
    }
    if update:
        _write(path, arrays, origin)
        return
    golden, then = _read(path)
    changed = [
        f"{name} {then.get(name)}, here {value}"
        for name, value in origin.items()
        if then.get(name) != value
    ]
    difference = _difference(golden, arrays)
    if difference:
        hint = f" (written with {'; '.join(changed)})" if changed else ""
        raise AssertionError(
            f"{path}: {difference}{hint}. If this is meant: pytest --golden-update"
        )


def _word(seed: Any) -> Seed:  # noqa: ANN401  a user's
    return None if seed is None else seeds.numbered_start(seed)


class _Function:
    """A policy without parameters."""

    def __init__(self, call: Callable[[FloatArray], FloatArray]) -> None:
        self._call = call

    def prepare(self, theta: FloatArray) -> FloatArray:
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:  # noqa: ARG002
        return self._call(x)


def _policy(policy: Any, task: Task, spec: TaskSpec) -> tuple[Acts, FloatArray]:  # noqa: ANN401  a user's
    """What acts, and its parameters (P,)."""
    if isinstance(policy, str):
        plugin = plugins.find("policies", policy)
        config = settings.from_dict(plugin.target.Config, {}, plugin.wire)
        built = build_policy(
            plugin, config, spec, draw_constants(plugin, config, task, spec, seeds.features(0))
        )
        return built, np.random.default_rng(0).normal(0.0, 0.5, built.size)
    if hasattr(policy, "problem"):  # a LoadedPolicy, of learner/
        return policy.problem.policy, policy.mu
    if not callable(policy):
        raise ConfigError(
            f"policy is a {type(policy).__name__}; expected that of farm.load, a function, or a"
            " name"
        )
    return _Function(policy), np.empty(0)


def _simulated(task: Task, policy: Any, words: Sequence[Seed]) -> dict[str, AnyArray]:  # noqa: ANN401
    """Arrays that the rollouts give, by name: (B, T, ...), states with their start
    (B, T + 1, ...), or (B,).
    """
    spec = specification(task)
    acts, theta = _policy(policy, task, spec)
    parameters = np.repeat(theta[None], len(words), axis=0)
    rollouts, trouble = tried(
        task, len(words), lambda sim: loop.run(task, acts, sim, parameters, words, spec)
    )
    if trouble.errors:
        raise trouble.errors[0]
    states = {
        name: np.concatenate([rollouts.start[name][:, None], after], 1)
        for name, after in rollouts.frames.items()
    }
    return {
        **{f"state/{name}": values for name, values in states.items()},
        "action": rollouts.actions,
        **{f"reward/{name}": rollouts.terms[:, :, at] for at, name in enumerate(spec.terms)},
        "steps": rollouts.steps,
        "success": rollouts.success,
        "failed": rollouts.failed,
        "return": rollouts.returns,
    }


def _difference(golden: dict[str, AnyArray], arrays: dict[str, AnyArray]) -> str:
    """The first number that differs, in words; nothing if none does."""
    if list(golden) != list(arrays):
        return f"the arrays are {', '.join(arrays)}; they were {', '.join(golden)}"
    for name, old in golden.items():
        new = arrays[name]
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            return f"{name} has shape {new.shape} of {new.dtype}; it had {old.shape} of {old.dtype}"
    unlike = {name: _unlike(old, arrays[name]) for name, old in golden.items()}
    wrong = np.any(
        [values.reshape(len(values), -1).any(axis=1) for values in unlike.values()], axis=0
    )
    if not wrong.any():
        return ""
    rollout = int(wrong.argmax())
    firsts = {name: np.argwhere(values[rollout]) for name, values in unlike.items()}
    name = min(
        (name for name in firsts if len(firsts[name])),
        key=lambda name: _moment(name, firsts[name][0]),
    )
    index = tuple(firsts[name][0].tolist())
    before, now = (values[name][rollout][index].item() for values in (golden, arrays))
    inner = "".join(f"[{each}]" for each in index[1:])
    return (
        f"rollout {rollout}{_when(name, index)}: {name}{inner} was {before!r}, is {now!r}; "
        f"{int(wrong.sum())} of {len(wrong)} rollouts differ"
    )


def _moment(name: str, index: IntArray) -> float:
    """The place of a row in time: a state, the action in it, the next state, the reward of that
    step, and so on.
    """
    kind = name.partition("/")[0]
    return 4 * int(index[0]) + _ORDER[kind] if kind in _ORDER else np.inf


def _when(name: str, index: tuple[int, ...]) -> str:
    kind = name.partition("/")[0]
    if kind not in _ORDER:
        return ""
    return (
        f", control step {index[0] + (kind != 'state')}"
        if kind != "state" or index[0]
        else ", start"
    )


def _unlike(old: AnyArray, new: AnyArray) -> AnyArray:
    """Which numbers have other bits."""
    if old.dtype.kind != "f":
        return old != new
    return np.ascontiguousarray(old).view(np.int64) != np.ascontiguousarray(new).view(np.int64)


def _write(path: Path, golden: dict[str, AnyArray], origin: dict[str, Any]) -> None:
    content, arrays = io.BytesIO(), {_MADE: np.array(json.dumps(origin)), **golden}
    np.savez_compressed(content, allow_pickle=False, **arrays)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as aside:
            aside.write_bytes(content.getvalue())


def _read(path: Path) -> tuple[dict[str, AnyArray], dict[str, Any]]:
    arrays = archives.arrays(path, "file of golden rollouts (remove it, and update)")
    try:
        return arrays, dict(json.loads(str(arrays.pop(_MADE))))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"{path} holds no golden rollouts ({type(error).__name__}): remove it, and update"
        ) from None
