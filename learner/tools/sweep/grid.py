"""Settings x seeds: the runs of a sweep, and its folder.

    sweep.json                 the varied settings, the seeds, and each setting's configuration
    SETTING-sSEED/             a run's folder each
    table.csv, .parquet, figure.svg      results

Seeds may be added to a sweep later; nothing else can be changed.
"""

import itertools
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from farm.errors import ConfigError, writing
from farm.net import keys
from farm.seeds import SEEDS
from farm.settings import read_json
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.files import replace_text

MOST: Final = 10_000
"""Largest number of runs of a sweep."""

_VERSION: Final = 1
_LONGEST: Final = 90  # characters of a setting in a run's name
_RANGE: Final = re.compile(r"(\d+)(?:-(\d+))?")


@dataclass(frozen=True)
class Setting:
    """One configuration of a sweep, for all seeds."""

    values: Mapping[str, str]
    """Varied values as given, by the flag's name with underscores."""
    config: RunConfig
    """The configuration with seed 0."""

    @property
    def label(self) -> str:
        """Name in tables and legends."""
        return ", ".join(f"{name} {value}" for name, value in self.values.items()) or "as given"


@dataclass(frozen=True)
class Sweep:
    """A sweep and its folder."""

    path: Path
    settings: tuple[Setting, ...]
    seeds: tuple[int, ...]

    @property
    def vary(self) -> dict[str, list[str]]:
        """The varied settings and their values."""
        names = self.settings[0].values
        return {
            name: list(dict.fromkeys(setting.values[name] for setting in self.settings))
            for name in names
        }

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Each setting's part of its runs' names: the varied values, or a number if those give no
        valid name.
        """
        plain = [_plain(setting.values) for setting in self.settings]
        count = Counter(plain)
        return tuple(
            name if count[name] == 1 and len(name) <= _LONGEST else f"setting-{i}"
            for i, name in enumerate(plain)
        )

    def folder(self, setting: int, seed: int) -> Path:
        """A run's folder."""
        return self.path / "-".join(
            [*([self.names[setting]] if self.names[setting] else []), f"s{seed}"]
        )

    @property
    def runs(self) -> dict[Path, RunConfig]:
        """Configurations by folder, seed by seed, so that every setting has an early result."""
        return {
            self.folder(i, seed): replace(setting.config, seed=seed)
            for seed in self.seeds
            for i, setting in enumerate(self.settings)
        }

    def prepare(self) -> None:
        """Make the folder, or continue with it; seeds may be added.

        Raises:
          ConfigError: it belongs to a different sweep, or is not a sweep's folder.
        """
        file = self.path / "sweep.json"
        with writing(f"to {self.path}", ConfigError):
            if file.exists():
                self._check_same(file)
            elif self.path.exists() and any(self.path.iterdir()):
                raise ConfigError(
                    f"{self.path} holds something else and no sweep.json: give a different --out"
                )
            self.path.mkdir(parents=True, exist_ok=True)
            settings = [configs.to_dict(setting.config) for setting in self.settings]
            data = {
                "version": _VERSION,
                "vary": self.vary,
                "seeds": list(self.seeds),
                "settings": settings,
            }
            replace_text(file, json.dumps(data, indent=2) + "\n")

    def _check_same(self, file: Path) -> None:
        """Check that an existing sweep is this one, perhaps with fewer seeds."""
        data = read_json(file, _VERSION, {"vary": dict, "seeds": list, "settings": list})
        if data["vary"] != self.vary:
            old, new = _words(data["vary"]), _words(self.vary)
            raise ConfigError(
                f"{self.path} varies {old}; here it is {new}: use the same values, or a different"
                " --out"
            )
        if missing := [str(seed) for seed in data["seeds"] if seed not in self.seeds]:
            raise ConfigError(
                f"{self.path} has seeds {', '.join(missing)} as well: give them too, or a different"
                " --out"
            )
        if len(data["settings"]) != len(self.settings):
            raise ConfigError(f"{file} is damaged: settings")
        for setting, values in zip(self.settings, data["settings"], strict=True):
            for name, old, new in configs.changes(
                configs.from_dict(values, str(file)), setting.config
            ):
                raise ConfigError(
                    f"{self.path} was started with --{name} {old}; here it is {new}: use that, or a"
                    " different --out"
                )


def _plain(values: Mapping[str, str]) -> str:
    """Varied values as part of a run's name; files without their folder."""
    parts = [f"{name}-{value.rpartition('/')[2]}" for name, value in values.items()]
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", "-".join(parts))


def _words(vary: Mapping[str, object]) -> str:
    lists = {
        name: values if isinstance(values, list) else [values] for name, values in vary.items()
    }
    return (
        " and ".join(f"{name}={','.join(map(str, values))}" for name, values in lists.items())
        or "nothing"
    )


def parse_vary(words: Sequence[str]) -> dict[str, list[str]]:
    """The values of each NAME=V1,V2,..., by name with underscores; a ConfigError if a word is
    malformed or repeated.
    """
    out: dict[str, list[str]] = {}
    for word in words:
        name, equals, listed = word.partition("=")
        name = name.strip().lstrip("-").replace("-", "_")
        values = [value.strip() for value in listed.split(",")]
        if not equals or not name or "" in values:
            raise ConfigError(
                f"--vary {word!r} is not of the form NAME=VALUE,VALUE, for example"
                " initial_sigma=0.1,0.2"
            )
        if name == "seed":
            raise ConfigError("--vary seed: give --seeds, for example --seeds 0-4")
        if name in out:
            raise ConfigError(f"--vary {name} is given twice: give all of its values at once")
        if len(set(values)) < len(values):
            raise ConfigError(f"--vary {word}: a value is given twice")
        out[name] = values
    return out


def parse_seeds(text: str) -> tuple[int, ...]:
    """A-B or A,B,C, or both, as seeds in that order; a ConfigError if one is malformed, too
    large or repeated.
    """
    out: list[int] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise ConfigError(f"--seeds {text!r} is not of the form A-B or A,B,C, for example 0-4")
        if last >= SEEDS or last - first >= MOST:
            raise ConfigError(f"--seeds {text!r}: expected at most {MOST} seeds below 2^32")
        out += range(first, last + 1)
    if len(set(out)) < len(out):
        raise ConfigError(f"--seeds {text!r}: a seed is given twice")
    return tuple(out)


def combinations(vary: Mapping[str, Sequence[str]], seeds: int) -> list[dict[str, str]]:
    """Every combination of values; the last name changes fastest.

    A ConfigError if there are too many runs.
    """
    settings = [
        dict(zip(vary, values, strict=True)) for values in itertools.product(*vary.values())
    ]
    total = len(settings) * seeds
    if total > MOST:
        raise ConfigError(
            f"{len(settings)} settings x {seeds} seeds are {total} runs; expected up to {MOST}"
        )
    return settings


def check(sweep: Sweep) -> None:
    """Check that no two settings give the same runs, and that run names are valid; else a
    ConfigError.
    """
    unique: dict[str, Setting] = {}
    for setting in sweep.settings:
        other = unique.setdefault(json.dumps(configs.to_dict(setting.config)), setting)
        if other is not setting:
            raise ConfigError(
                f"--vary: {other.label} and {setting.label} are the same configuration"
            )
    for path in sweep.runs:
        keys.checked("run", path.name)
