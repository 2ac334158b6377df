"""The configuration of a run: everything its numbers depend on. Pure but for reading the file."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_type_hints

from farm import tasks
from farm.errors import ConfigError
from farm.policies.fourier import PolicyConfig
from farm.seeds import SEEDS
from farm.tasks.finger_gait.task import TaskConfig
from learner.algorithms import ALGORITHMS, PGPE, Algorithm, name_of

VERSION: Final = 1
"""Version of config.json."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run. Same configuration, same numbers to the last bit, however many workers there are."""

    task: TaskConfig = field(default_factory=lambda: TaskConfig(perturb=True))
    """The task."""
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(controller="kernel"))
    """The controller."""
    algorithm: Algorithm[Any] = field(
        default_factory=lambda: PGPE(initial_mu=1.75, initial_sigma=0.8, sigma_rule="capped")
    )
    """The learning rule."""
    seed: int = 0
    """Seed of everything random in the run."""
    generations: int = 150
    """Updates of the search distribution."""
    stop_when_solved: int | None = None
    """End after so many generations in a row in which the mean policy succeeded."""
    init_from: str | None = None
    """Start from the mean, sigma and random features of another run: its folder."""
    init_sigma: Literal["run", "fresh"] = "run"
    """With init-from: take that run's sigma as well, or start with --initial-sigma."""
    traces: Literal["all", "extremes", "none"] = "extremes"
    """Tactile traces that are recorded: of all rollouts, of the best and worst of a generation, or none."""

    def __post_init__(self) -> None:
        """Check every value."""
        if not 0 <= self.seed < SEEDS:
            raise ConfigError(f"seed is {self.seed}; expected 0 to 2^32 - 1")
        if not 0 <= self.generations <= 10_000_000:
            raise ConfigError(f"generations is {self.generations}; expected 0 to 10000000")
        self._check_task()
        if self.stop_when_solved is not None and self.stop_when_solved < 1:
            raise ConfigError(f"stop-when-solved is {self.stop_when_solved}; expected 1 or more")
        kinds = {f.name: f.type for f in dataclasses.fields(self)}
        for name in ("init_sigma", "traces"):
            value, known = getattr(self, name), get_args(kinds[name])
            if value not in known:
                raise ConfigError(f"{name.replace('_', '-')} is {value!r}; known are {', '.join(known)}")

    def _check_task(self) -> None:
        """See that nothing is asked of a task that it does not have."""
        if self.stop_when_solved is not None and not tasks.sizes(self.task).success:
            raise ConfigError(f"--stop-when-solved: {self.task.task} knows returns, but no success")
        plain = PolicyConfig()
        if self.task.kind != "finger-gait" and (self.policy.action, self.policy.clip) != (plain.action, plain.clip):
            raise ConfigError(
                f"--action and --clip are settings of finger-gait; actions of {self.task.task} are rescaled"
            )


PRESETS: Final[dict[str, RunConfig]] = {
    "default": RunConfig(),
    "thesis": RunConfig(
        task=TaskConfig(), policy=PolicyConfig(), algorithm=PGPE(normaliser="thesis", sigma_rule="bare")
    ),
    "gym": RunConfig(
        task=TaskConfig(task="gym:Swimmer-v5", gamma=1.0, perturb=True),
        policy=PolicyConfig(controller="direct", features=50, bandwidth=3.0),
        algorithm=PGPE(
            initial_mu=0.0, initial_sigma=0.1, shaping="ranks", optimiser="clipup", learning_rate_mu=0.1,
            learning_rate_sigma=0.1, sigma_rule="capped", max_speed=0.2,
        ),
    ),
}  # fmt: skip
"""Configurations by name: what learns most surely, the thesis' own set-up, and Gymnasium's environments."""


def preset_for(kind: str) -> str:
    """The preset that runs of a kind of task begin with: the one of its name, or `default`."""
    return kind if kind in PRESETS else "default"


def preset(name: str) -> RunConfig:
    """The configuration of that name.

    Raises:
      ConfigError: there is none.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; known are {', '.join(PRESETS)}")
    return PRESETS[name]


def algorithm(name: str) -> type[Algorithm[Any]]:
    """The algorithm of that name.

    Raises:
      ConfigError: there is none.
    """
    if name not in list(ALGORITHMS):
        raise ConfigError(f"unknown algorithm {name!r}; known are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


_APART: Final = {"task", "seed", "generations", "traces", "stop-when-solved"}


def preset_of(config: RunConfig) -> str:
    """The preset that a configuration is but for its task's name, seed and length, "own" where it is none."""
    for name, known in PRESETS.items():
        if {change[0] for change in changes(known, config)} <= _APART:
            return name
    return "own"


def properties(config: RunConfig) -> dict[str, str | int]:
    """What tells a run from others at a glance."""
    task = {"state": config.task.state, "object": config.task.object}
    if config.task.kind != "finger-gait":
        task = {"task": config.task.task}
    return {"preset": preset_of(config), "controller": config.policy.controller, **task, "seed": config.seed}


def to_dict(config: RunConfig) -> dict[str, Any]:
    """As it stands in config.json and in a checkpoint."""
    named = {"name": name_of(config.algorithm), **dataclasses.asdict(config.algorithm)}
    return {"version": VERSION, **dataclasses.asdict(config), "algorithm": named}


def from_dict(values: object, where: str) -> RunConfig:
    """The configuration in a parsed config.json.

    Raises:
      ConfigError: another version, unknown names, wrong types or impossible values; `where` is named.
    """
    if not isinstance(values, dict) or values.get("version") != VERSION:
        found = values.get("version") if isinstance(values, dict) else None
        raise ConfigError(f"{where}: not a configuration of version {VERSION} (found {found!r})")
    try:
        return _build(RunConfig, {k: v for k, v in values.items() if k != "version"}, "")
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{where}: {error}") from None
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def read(path: Path) -> RunConfig:
    """The configuration in a file.

    Raises:
      ConfigError: it cannot be read or makes no sense.
    """
    try:
        values = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}") from None
    return from_dict(values, str(path))


def changes(old: RunConfig, new: RunConfig) -> Iterator[tuple[str, object, object]]:
    """Settings that differ: name, old and new value; of another algorithm only those that both have."""
    before, after = settings(old), settings(new)
    for name, value in before.items():
        if name in after and value != after[name]:
            yield name, value, after[name]


def settings(config: RunConfig) -> dict[str, object]:
    """Every setting by its flag's name; `algorithm` is the algorithm's name."""
    tables: dict[str, Any] = dataclasses.asdict(config)
    task, policy, rule = tables.pop("task"), tables.pop("policy"), tables.pop("algorithm")
    flat = {**task, **policy, "algorithm": name_of(config.algorithm), **rule, **tables}
    return {name.replace("_", "-"): value for name, value in flat.items()}


def _build(kind: type[Any], values: dict[str, Any], prefix: str) -> Any:  # noqa: ANN401  a dataclass of that kind
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = [prefix + name for name in values if name not in fields]
    if unknown:
        raise ConfigError(f"unknown setting {', '.join(unknown)}")
    default, hints = kind(), get_type_hints(kind)
    made = {}
    for name, value in values.items():
        nested = getattr(default, name)
        if dataclasses.is_dataclass(nested):
            if not isinstance(value, dict):
                raise ConfigError(f"{prefix}{name} is {value!r}; expected a table of settings")
            nested_kind = algorithm(value.get("name", "pgpe")) if name == "algorithm" else type(nested)
            table = {k: v for k, v in value.items() if (name, k) != ("algorithm", "name")}
            made[name] = _build(nested_kind, table, f"{prefix}{name}.")
        else:
            made[name] = _scalar(f"{prefix}{name}", nested, value, hints[name])
    return kind(**made)


def _scalar(name: str, default: object, value: object, kind: object) -> object:
    """The value, if it is of the default's type (a float may be written as an int), or of an optional's kind."""
    if isinstance(default, float) and type(value) is int:
        return float(value)
    known = get_args(kind) if default is None else (type(default),)
    if type(value) in known:
        return value
    raise ConfigError(f"{name} is {value!r}; expected {' or '.join(k.__name__ for k in known)}")
