"""The configuration of a run: everything its numbers depend on. Pure but for reading the file."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

from farm.errors import ConfigError
from farm.policy import PolicyConfig
from farm.randomness import SEEDS
from farm.tasks.finger_gait import TaskConfig
from learner.algorithms import PGPE

VERSION: Final = 1
"""Version of config.json."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run. Same configuration, same numbers to the last bit, however many workers there are."""

    task: TaskConfig = field(default_factory=lambda: TaskConfig(perturb=True))
    """The task."""
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(controller="kernel"))
    """The controller."""
    algorithm: PGPE = field(default_factory=lambda: PGPE(initial_mu=1.75, initial_sigma=0.8, sigma_rule="capped"))
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
        if self.stop_when_solved is not None and self.stop_when_solved < 1:
            raise ConfigError(f"stop-when-solved is {self.stop_when_solved}; expected 1 or more")
        kinds = {f.name: f.type for f in dataclasses.fields(self)}
        for name in ("init_sigma", "traces"):
            value, known = getattr(self, name), get_args(kinds[name])
            if value not in known:
                raise ConfigError(f"{name.replace('_', '-')} is {value!r}; known are {', '.join(known)}")


PRESETS: Final[dict[str, RunConfig]] = {
    "default": RunConfig(),
    "thesis": RunConfig(
        task=TaskConfig(), policy=PolicyConfig(), algorithm=PGPE(normaliser="thesis", sigma_rule="bare")
    ),
}
"""Configurations by name: what learns most surely, and the thesis' own set-up."""


def preset(name: str) -> RunConfig:
    """The configuration of that name.

    Raises:
      ConfigError: there is none.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; known are {', '.join(PRESETS)}")
    return PRESETS[name]


def to_dict(config: RunConfig) -> dict[str, Any]:
    """As it stands in config.json and in a checkpoint."""
    return {"version": VERSION, **dataclasses.asdict(config)}


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
    """Settings that differ: name, old and new value."""
    yield from _changes(dataclasses.asdict(old), dataclasses.asdict(new))


def _changes(old: dict[str, Any], new: dict[str, Any]) -> Iterator[tuple[str, object, object]]:
    for name, value in old.items():
        if isinstance(value, dict):
            yield from _changes(value, new[name])
        elif value != new[name]:
            yield name.replace("_", "-"), value, new[name]


def _build(kind: type[Any], values: dict[str, Any], prefix: str) -> Any:  # noqa: ANN401  a dataclass of that kind
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = [prefix + name for name in values if name not in fields]
    if unknown:
        raise ConfigError(f"unknown setting {', '.join(unknown)}")
    default = kind()
    made = {}
    for name, value in values.items():
        nested = getattr(default, name)
        if dataclasses.is_dataclass(nested):
            if not isinstance(value, dict):
                raise ConfigError(f"{prefix}{name} is {value!r}; expected a table of settings")
            made[name] = _build(type(nested), value, f"{prefix}{name}.")
        else:
            made[name] = _scalar(f"{prefix}{name}", nested, value, fields[name].type)
    return kind(**made)


def _scalar(name: str, default: object, value: object, kind: object) -> object:
    """The value, if it is of the default's type (a float may be written as an int), or of an optional's kind."""
    if isinstance(default, float) and type(value) is int:
        return float(value)
    known = get_args(kind) if default is None else (type(default),)
    if type(value) in known:
        return value
    raise ConfigError(f"{name} is {value!r}; expected {' or '.join(k.__name__ for k in known)}")
