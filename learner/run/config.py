"""The configuration of a run: all settings that its numbers depend on."""

import dataclasses
import inspect
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, cast

from farm import plugins, settings
from farm.errors import ConfigError
from farm.policies.base import Policy, PolicyConfig
from farm.seeds import SEEDS
from farm.settings import Settings, setting
from farm.tasks.base import Task, TaskConfig
from learner.algorithms import Algorithm

VERSION: Final = 2
"""Version of config.json."""

MOST_GENERATIONS: Final = 10_000_000
"""Largest number of generations of a run."""

VALIDATION_ROLLOUTS: Final = 16
"""Starts from which a mean policy is validated."""

_LEAST_EXPLORING: Final = 20  # rollouts for each one of validation, which so are at most 5 %

PARTS: Final = {"task": "tasks", "policy": "policies", "algorithm": "algorithms"}
"""Parts of a configuration that are chosen by name and have their own settings, with the kind of
plug-in.
"""


@dataclass(frozen=True, kw_only=True)
class RunConfig(Settings):
    """A run.

    The same configuration gives the same numbers to the last bit for any number of workers.

    Omitted settings are those of the task's first preset: `RunConfig(task="gym:Swimmer-v5")` can be
    learnt.

    Raises:
      ConfigError: a value is invalid, or settings contradict each other.

    Example:
      ```python
      import farm

      config = farm.RunConfig(task="finger-gait", policy="linear", seed=3, generations=20)
      assert (config.algorithm, config.task_config.perturb) == ("pgpe", True)
      ```
    """

    task: str = "finger-gait"
    """What is learnt: a name (farm tasks lists them), gym:NAME, or FILE.py:CLASS."""
    policy: str = ""
    """The controller: a name (farm tasks lists them), or FILE.py:CLASS."""
    algorithm: str = ""
    """The learning rule: a name (farm tasks lists them), or FILE.py:CLASS."""
    task_config: TaskConfig = cast("TaskConfig", None)  # filled in below
    """Settings of the task."""
    policy_config: PolicyConfig = cast("PolicyConfig", None)
    """Settings of the policy."""
    algorithm_config: Algorithm[Any] = cast("Algorithm[Any]", None)
    """Settings of the algorithm."""
    seed: int = setting(0, least=0, most=SEEDS - 1)
    """Seed of everything random in the run."""
    generations: int = setting(None, least=0, most=MOST_GENERATIONS)  # filled in below
    """Updates of the search distribution."""
    stop_when_solved: int | None = setting(None, least=1)
    """End when the mean policy has succeeded in this number of successive generations, at least
    those of --average.
    """
    stop_after_steps: int | None = setting(None, least=1)
    """End after the generation in which the exploring rollouts reach this total number of control
    steps.
    """
    stop_when_stale: int | None = setting(None, least=1)
    """End when no validated mean policy has been better for this number of generations (early
    stopping); needs --validate.
    """
    episodes: int = setting(1, least=1, most=1000)
    """Rollouts of each mu + eps and mu - eps, whose mean return counts.

    With 2 or more, on starts that all share.
    """
    shared_starts: int | None = setting(None, least=1)
    """Different starts in a generation, which its pairs take in turn; by default each pair has its
    own.
    """
    average: int = setting(1, least=1, most=MOST_GENERATIONS)
    """Number of last generations whose means are averaged to give the final policy."""
    interactions: int | None = setting(None, least=1)
    """Control steps that a generation should have: the number of pairs, from --pairs to
    --most-pairs, follows from the steps per pair in the previous generation (Toklu 2020).
    """
    most_pairs: int | None = setting(None, least=1)
    """With --interactions: largest number of pairs in a generation.

    By default eight times --pairs.
    """
    init_from: str | None = None
    """Start from the mean, sigma and constants of another run: its folder.

    It may be of another task with observations and actions of the same sizes; sigma and steps then
    begin anew.
    """
    init_sigma: Literal["run", "fresh"] = "run"
    """With --init-from RUN of the same task: take that run's sigma as well, or begin anew."""
    start: Literal["printed", "fitted"] = "printed"
    """Use --bandwidth and --initial-sigma as given, or fit them to the observation (policies
    kernel, projected).
    """
    pilot: bool = setting(None)  # filled in below
    """Measure before the first generation how far the search explores, and scale sigma and steps to
    it.

    Left out if --initial-sigma, --sigma-floor, --learning-rate-mu, --max-speed is given, or
    --init-from with that run's sigma.
    """
    pilot_sigma: float | None = setting(None, above=0.0)
    """The initial sigma that a pilot found (a run fills it in); steps are in proportion.

    With it there is no pilot.
    """
    validate: bool = setting(None)  # filled in below
    """Now and then simulate the mean policy from starts that no learning uses, with at most 5 %
    more rollouts, and take the best one as the run's policy; say at the end what it is worth beside
    doing nothing.
    """
    shrink_after: int = setting(0, least=0)
    """Halve the search's steps when so many validations in succession have not been better; 0:
    never. Needs --validate.
    """
    traces: Literal["all", "extremes", "none"] = "extremes"
    """Which traces are recorded: those of all rollouts, of the best and worst of each generation,
    or none.
    """

    def __post_init__(self) -> None:
        """Fill in omitted settings, and check every value."""
        for part, kind in PARTS.items():
            if name := getattr(self, part):
                # The name of a class in a file has the file's absolute path
                object.__setattr__(self, part, plugins.find(kind, name).name)
        for name, value in _filled(self).items():
            object.__setattr__(self, name, value)
        self._check_parts()
        super().__post_init__()
        if self.init_from is not None:  # wherever it is repeated from
            object.__setattr__(self, "init_from", str(Path(self.init_from).absolute()))
        self._check_interactions()
        self._check_pilot()
        self._check_shrinking()
        if self.stop_when_stale is not None and not self.validate:
            raise ConfigError(
                "--stop-when-stale compares validated policies, and this run validates none: give"
                " --validate too"
            )
        if self.episodes > 1 and not self.task_config.perturb:
            raise ConfigError(
                f"--episodes {self.episodes} and --no-perturb exclude each other: unperturbed"
                " rollouts are all alike"
            )
        self._check_shared_starts()
        owners: dict[str, str] = {"name": "plug-in"}
        for part in ("run", *PARTS):
            for name in _fields(self if part == "run" else getattr(self, f"{part}_config")):
                if owners.setdefault(name, part) != part:
                    whose = f"{part} {getattr(self, part)!r}"
                    raise ConfigError(
                        f"setting {name!r} of the {whose} is also the {owners[name]}'s: rename one"
                    )

    def _check_parts(self) -> None:
        """Check that each part's settings are that part's."""
        for part, kind in PARTS.items():
            name, options = getattr(self, part), getattr(self, f"{part}_config")
            expected = settings_class(kind, name)
            if not dataclasses.is_dataclass(options) or _fields(options) != _fields(expected):
                raise ConfigError(
                    f"{part}_config is a {type(options).__name__}; expected the"
                    f" {expected.__qualname__} of {name}: farm.configure takes each setting by its"
                    " name"
                )

    def _check_shrinking(self) -> None:
        if not self.shrink_after:
            return
        algorithm: Any = self.algorithm_config
        if not self.validate:
            what = "this run validates nothing: give --validate too"
        elif not hasattr(algorithm, "scaled"):
            what = f"algorithm {self.algorithm} has no method scaled(sigma)"
        elif _in_proportion(algorithm):
            what = f"those of {self.algorithm} are in proportion to sigma with these settings"
        else:
            return
        raise ConfigError(f"--shrink-after halves steps after validations, but {what}")

    def _check_shared_starts(self) -> None:
        if self.shared_starts is None:
            return
        if self.episodes > 1:
            raise ConfigError(
                "--shared-starts is for pairs of one start each, and with --episodes all pairs"
                " share theirs: give one of the two"
            )
        if not self.task_config.perturb:
            raise ConfigError(
                f"--shared-starts {self.shared_starts} and --no-perturb exclude each other:"
                " unperturbed rollouts have all the same start"
            )

    def _check_interactions(self) -> None:
        least = getattr(self.algorithm_config, "pairs", None)
        if self.interactions is not None and least is None:
            raise ConfigError(
                f"--interactions needs an algorithm with --pairs, which {self.algorithm} does not"
                " have"
            )
        if self.most_pairs is not None and self.interactions is None:
            raise ConfigError("--most-pairs is for --interactions: give both")
        if self.most_pairs is not None and least is not None and self.most_pairs < least:
            raise ConfigError(f"most-pairs is {self.most_pairs}; expected at least {least} (pairs)")

    def _check_pilot(self) -> None:
        if (self.pilot or self.pilot_sigma is not None) and not hasattr(
            self.algorithm_config, "scaled"
        ):
            raise ConfigError(
                f"--pilot: algorithm {self.algorithm} has no method scaled(sigma); give --no-pilot"
            )

    def algorithm_of(self, pairs: int = 0, steps: float = 1.0) -> Algorithm[Any]:
        """The algorithm as the search uses it: scaled by the pilot, with this number of pairs (0:
        its own), and with steps of this share of its own.
        """
        algorithm: Any = self.algorithm_config
        if self.pilot_sigma is not None:
            algorithm = algorithm.scaled(self.pilot_sigma)
        if steps != 1.0:
            algorithm = algorithm.scaled(algorithm.initial_sigma * steps)
        return replace(algorithm, pairs=pairs) if pairs else algorithm

    def validates(self, generation: int, rollouts: int) -> bool:
        """Whether a generation with this number of exploring rollouts also validates its mean
        policy.
        """
        return (
            self.validate
            and generation % -(-_LEAST_EXPLORING * VALIDATION_ROLLOUTS // rollouts) == 0
        )

    def pairs_after(self, pairs: int, steps: int) -> int:
        """Pairs of the generation after one with these pairs and control steps; 0: as in the
        algorithm's settings.
        """
        if self.interactions is None:
            return 0
        least: int = self.algorithm_config.pairs  # type: ignore[attr-defined]
        return min(
            max(-(-self.interactions * (pairs or least) // steps), least), self.pairs_at_most
        )

    @property
    def pairs_at_most(self) -> int:
        """Largest number of pairs in a generation, with interactions."""
        least: int = self.algorithm_config.pairs  # type: ignore[attr-defined]
        return 8 * least if self.most_pairs is None else self.most_pairs


def _fields(kind: Any) -> list[str]:  # noqa: ANN401  a dataclass
    return [each.name for each in dataclasses.fields(kind)]


def _filled(config: RunConfig) -> dict[str, Any]:
    """Fill in omitted settings from the task's first preset."""
    parts = (
        config.policy,
        config.algorithm,
        config.task_config,
        config.policy_config,
        config.algorithm_config,
    )
    if all(parts) and None not in (config.generations, config.pilot, config.validate):
        return {}
    table = presets(config.task)
    preset: dict[str, Any] = dict(next(iter(table.values()), {}))
    out: dict[str, Any] = {}
    if config.generations is None:
        out["generations"] = preset.get("generations", _GENERATIONS)
    for part, kind in PARTS.items():
        name = getattr(config, part) or preset.get(part) or _GENERAL[part]
        options = getattr(config, f"{part}_config")
        usual = preset
        if part == "policy" and name != preset.get(part, name):
            usual = {each: value for each, value in preset.items() if each in _taken(name)}
        out |= {part: name, f"{part}_config": options or _part(kind, name, usual)}
    if config.pilot is None:
        out["pilot"] = (
            bool(preset.get("pilot"))
            and not all(parts)
            and hasattr(out["algorithm_config"], "scaled")
        )
    if config.validate is None:
        out["validate"] = bool(preset.get("validate")) and not all(parts)
    return out


def _in_proportion(algorithm: Any) -> bool:  # noqa: ANN401
    """Whether an algorithm has no steps that are lengths: only sigma and its floor are scaled."""
    scaled = algorithm.scaled(algorithm.initial_sigma / 2.0)
    of_sigma = ("initial_sigma", "sigma_floor")
    lengths = (name for name in vars(algorithm) if name not in of_sigma)
    return all(getattr(scaled, name) == getattr(algorithm, name) for name in lengths)


SCALE: Final = frozenset({"initial_sigma", "sigma_floor", "learning_rate_mu", "max_speed"})
"""Settings of which each, given by the user, leaves out the pilot."""


def pilot_unless(config: RunConfig, names: Collection[str]) -> RunConfig:
    """Switch the pilot off if these settings, which the user has given, say how far the search
    explores or steps.

    Args:
      config: with the settings.
      names: of the given settings, with underscores. With `pilot` among them the pilot is as the
        user says.
    """
    off = "pilot" not in names and not _pilots(config.algorithm_config, names)
    if "pilot" not in names and not off:
        return config
    pilot = config.pilot and not off
    sigma = config.pilot_sigma if "pilot_sigma" in names else None  # a new one, or none
    if (pilot, sigma) == (config.pilot, config.pilot_sigma):
        return config
    return replace(config, pilot=pilot, pilot_sigma=sigma)


def _pilots(algorithm: Algorithm[Any], names: Collection[str]) -> bool:
    """Whether a pilot may scale an algorithm when a user has given settings of these names."""
    return hasattr(algorithm, "scaled") and not SCALE.intersection(names)


_GENERATIONS: Final = 150
"""Defaults of presets."""

_FEW: Final = 5
"""Observed numbers up to which random features learn more than a linear policy: they cover few
dimensions only.
"""

_DISTANT: Final = 4
"""Observed numbers from which on normalised observations are farther apart, and features wider."""

_WIDE: Final = 2.0  # bandwidth of wider features

_PGPE: Final[Mapping[str, Any]] = {
    "algorithm": "pgpe",
    "initial_mu": 0.0,
    "shaping": "signed-ranks",
    "optimiser": "clipup",
    "sigma_rule": "capped",
    "learning_rate_sigma": 0.1,
}

_GENERAL: Final[Mapping[str, Any]] = {
    **_PGPE,
    "policy": "direct",
    "normalise": True,
    "features": 50,
    "bandwidth": 1.0,
    "pilot": True,
    "validate": True,
    "initial_sigma": 1.0,
    "learning_rate_mu": 0.5,
    "max_speed": 1.0,
}
"""The settings that runs start from, if the task has no presets and observes few numbers."""

_MANY: Final[Mapping[str, Any]] = {
    **_PGPE,
    "policy": "linear",
    "normalise": True,
    "pilot": True,
    "validate": True,
    "initial_sigma": 0.1,
    "learning_rate_mu": 0.05,
    "max_speed": 0.1,
}
"""Settings of a task that observes more."""


_POINTS: Final = ("kernel", "projected")
"""Policies whose parameters are points among the observations, whose units must stay."""

_DEFAULT_PARTS: Final = {part: _GENERAL[part] for part in ("policy", "algorithm")}


@cache
def _general(task: plugins.Plugin) -> Mapping[str, Any]:
    """Settings of a task without presets."""
    # Imports MuJoCo, which looks for a screen once, when it is imported
    from farm.runner import build_task
    from farm.tasks.probe import specification

    with suppress(Exception):  # what is wrong with it is said when it is used
        spec = plugins.no_exit(specification)(build_task(task, {}, None))
        if spec.observation > _FEW:
            return _MANY
        return _GENERAL if spec.observation < _DISTANT else {**_GENERAL, "bandwidth": _WIDE}
    return _GENERAL


def settings_class(kind: str, name: str) -> type[Any]:
    """The dataclass of a plug-in's settings: its `Config`, or the class itself.

    Raises:
      ConfigError: there is no such plug-in, or it is of another kind.
    """
    target = plugins.find(kind, name).target
    base = {"tasks": Task, "policies": Policy}.get(kind)
    if base is not None and not (isinstance(target, type) and issubclass(target, base)):
        raise ConfigError(
            f"{name} is not a {base.__name__}: derive its class from farm.{base.__name__}"
        )
    config = getattr(target, "Config", target)
    if base is None and not all(
        hasattr(config, each) for each in ("signs", "init", "restore", "ask", "tell")
    ):
        raise ConfigError(f"{name} is no algorithm: it needs signs, init, restore, ask and tell")
    if not dataclasses.is_dataclass(config) or "Config" in vars(target) and _undecorated(config):
        raise ConfigError(
            f"settings of {name}: put @dataclass(frozen=True, kw_only=True) on its class"
        )
    settings_base = {"tasks": TaskConfig, "policies": PolicyConfig}.get(kind, object)
    if not issubclass(config, settings_base):
        raise ConfigError(
            f"settings of {name}: derive its Config from farm.{settings_base.__name__}"
        )
    return cast("type[Any]", config)


def _undecorated(config: type) -> bool:
    return any(name not in _fields(config) for name in inspect.get_annotations(config))


def _part(kind: str, name: str, values: Mapping[str, Any]) -> Any:  # noqa: ANN401  settings of that plug-in
    config = settings_class(kind, name)
    arguments = {each: value for each, value in values.items() if each in _fields(config)}
    return settings.from_dict(config, arguments, name)


def _taken(policy: str) -> set[str]:
    """Names of the settings that a policy takes from those of another one."""
    names = set(_fields(settings_class("policies", policy)))
    return names - {"normalise"} if policy in _POINTS else names


def presets(task: str) -> dict[str, Mapping[str, Any]]:
    """Settings that runs of a task start from, by preset and flag.

    The first preset is the default.
    """
    settings_class("tasks", task)
    plugin = plugins.find("tasks", task)
    tables = plugin.target.presets
    if (
        not isinstance(tables, Mapping)
        or not tables
        or not all(isinstance(each, Mapping) for each in tables.values())
    ):
        raise ConfigError(f"presets of {task}: expected tables of settings by name, one or more")
    return {name: table or _general(plugin) for name, table in tables.items()}


def configure(task: str = "finger-gait", preset: str | None = None, **changed: Any) -> RunConfig:  # noqa: ANN401
    """A preset with some settings changed, each by its flag's name.

    Raises:
      ConfigError: there is no such task, preset or setting, or a value is invalid.

    Example:
      ```python
      import farm

      config = farm.configure("finger-gait", policy="linear", friction=0.5, pairs=10)
      assert (config.task_config.friction, config.algorithm_config.pairs) == (0.5, 10)
      ```
    """
    table = presets(task)
    name = preset or next(iter(table))
    if name not in table:
        raise ConfigError(f"unknown preset {name!r} of task {task}; known are {', '.join(table)}")
    first = next(iter(table.values()))
    general = {part: first.get(part, default) for part, default in _DEFAULT_PARTS.items()}
    values = {"generations": _GENERATIONS, **general, **table[name], "task": task}
    for part in general:
        choice = str(changed.get(part, values[part]))
        if choice != values[part]:
            # Another policy keeps what it has of the preset's settings, another algorithm nothing
            common = _taken(choice) if part == "policy" else set()
            replaced = _fields(settings_class(PARTS[part], str(values[part])))
            values = {k: v for k, v in values.items() if k in common or k not in replaced}
    of_preset = set(values) & set(table[name])
    values |= changed
    parts, names = _parts(values, {})
    if unknown := sorted(of_preset - names - set(_fields(RunConfig))):
        raise ConfigError(f"preset {name!r} of task {task}: unknown setting {', '.join(unknown)}")
    if "pilot" not in changed:
        pilots = _pilots(parts["algorithm_config"], changed)
        values["pilot"] = pilots and bool(values.get("pilot"))
    values["validate"] = bool(values.get("validate"))
    return RunConfig(**parts, **_of_run(values, names))


def changed_by(config: RunConfig, values: Mapping[str, Any]) -> RunConfig:
    """A configuration with some settings changed, each by its flag's name.

    A part that is replaced starts with its replaced defaults.
    """
    if not values:
        return config
    names = {part: getattr(config, part) for part in PARTS}
    before = {
        part: getattr(config, f"{part}_config")
        for part, name in names.items()
        if values.get(part, name) == name
    }
    parts, owned = _parts({**names, **values}, before)
    run = _of_run(values, owned)
    if config.pilot and not hasattr(parts["algorithm_config"], "scaled"):
        run.setdefault("pilot", False)
    if any(parts[part] != getattr(config, part) for part in PARTS):
        run.setdefault("pilot_sigma", None)  # it was measured for another search
    return replace(config, **parts, **run)


def _parts(values: Mapping[str, Any], before: Mapping[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """Parts of a RunConfig from settings by name, and the names that they have taken.

    Args:
      values: names of the parts, and settings of all.
      before: settings of the parts that stay, changed by those.
    """
    out: dict[str, Any] = {}
    names = set(PARTS)
    for part, kind in PARTS.items():
        name = values[part]
        old = settings.to_dict(before[part]) if part in before else {}
        names |= set(_fields(settings_class(kind, name)))
        out |= {part: name, f"{part}_config": _part(kind, name, {**old, **values})}
    return out, names


def _of_run(values: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Settings of the run itself.

    Raises:
      ConfigError: one belongs neither to the run nor to the parts, which have these names.
    """
    fields = set(_fields(RunConfig)) - {f"{part}_config" for part in PARTS}
    if unknown := [name for name in values if name not in names and name not in fields]:
        raise ConfigError(f"unknown setting {', '.join(unknown)}")
    return {name: value for name, value in values.items() if name not in names}


def checked(config: object) -> None:
    """Check that something is a run's configuration, as the functions of Python's users take it."""
    if not isinstance(config, RunConfig):
        raise ConfigError(
            f"config is {config!r:.60}; expected a farm.RunConfig, as of farm.configure(TASK)"
        )


AT_THE_END: Final = ("generations", "average")
"""Settings that say where a run ends and with what policy: a resumed run may change them."""
_APART: Final = frozenset(
    ("task", "seed", "generations", "traces", "stop-when-solved", "stop-after-steps", "pilot-sigma")
)


def preset_of(config: RunConfig) -> str:
    """The preset that a configuration equals except for seed and length, or "own"."""
    for name in presets(config.task):
        if {change[0] for change in changes(configure(config.task, name), config)} <= _APART:
            return name
    return "own"


def properties(config: RunConfig) -> dict[str, str | int]:
    """A short description of a run."""
    return {
        "preset": preset_of(config),
        "policy": config.policy,
        "task": config.task,
        "seed": config.seed,
    }


def to_dict(config: RunConfig) -> dict[str, Any]:
    """Convert a configuration to its form in config.json and in a checkpoint."""
    parts = {
        part: {"name": getattr(config, part), **settings.to_dict(getattr(config, f"{part}_config"))}
        for part in PARTS
    }
    rest = {
        name: getattr(config, name)
        for name in _fields(config)
        if name.removesuffix("_config") not in PARTS
    }
    return {"version": VERSION, **parts, **rest}


def localised(values: Mapping[str, Any], files: Sequence[Path]) -> dict[str, Any]:
    """A parsed config.json whose classes come from these files, where one is the class's file, or
    else has its name.
    """
    out = dict(values)
    for part in PARTS:
        table = values.get(part)
        path, _, inside = str(table.get("name") if isinstance(table, dict) else "").rpartition(":")
        here = [file for file in files if path.endswith(".py") and file.name == Path(path).name]
        here = [file for file in here if file.resolve() == Path(path)] or here
        if isinstance(table, dict) and here:
            out[part] = {**table, "name": f"{here[0].resolve()}:{inside}"}
    return out


def class_files(config: RunConfig) -> tuple[Path, ...]:
    """The files of its classes."""
    names = (plugins.named_file(getattr(config, part)) for part in PARTS)
    return tuple(Path(name) for name in dict.fromkeys(names) if name)


def _check_file(
    where: str, part: str, name: str, folder: Path | None, files: Sequence[Path]
) -> None:
    """Check that a class's file is one that the run itself, or its user, has named: importing it
    runs its code.

    Raises:
      ConfigError: its path is relative, it lies in the run's folder, or it is not on this machine.
    """
    path = Path(plugins.named_file(name))
    if not path.name or path in [file.resolve() for file in files]:
        return
    remedy = f"--allow-file {path.name} takes the class from a file that you trust"
    if not path.is_absolute():
        raise ConfigError(
            f"{where}: {part} is {name[:200]!r}, and a run writes absolute paths only; {remedy}"
        )
    if folder is not None and path.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(
            f"{where}: {part} is a class in the run's own folder ({path}), whose code would run;"
            f" {remedy}"
        )
    if not path.exists():
        raise ConfigError(
            f"{where}: {part} is a class in {path}, and there is no such file here; {remedy}"
        )


def from_dict(
    values: object, where: str, files: Sequence[Path] = (), folder: Path | None = None
) -> RunConfig:
    """The configuration in a parsed config.json.

    Args:
      values: what was parsed.
      where: its origin, for errors.
      files: which the user named: classes in files of these names are taken from them.
      folder: of the run; a class in it is refused unless its file is one of those.

    Raises:
      ConfigError: another version, unknown names, wrong types or impossible values; `where` is
          named.
    """
    values = localised(values, files) if isinstance(values, dict) else values
    if not isinstance(values, dict) or values.get("version") != VERSION:
        version = values.get("version") if isinstance(values, dict) else None
        raise ConfigError(
            f"{where}: not a configuration of version {VERSION} (found {str(version)[:40]!r})"
        )
    arguments: dict[str, Any] = {k: v for k, v in values.items() if k not in ("version", *PARTS)}
    if unknown := [name for name in (f"{part}_config" for part in PARTS) if name in arguments]:
        raise ConfigError(f"{where}: unknown setting {', '.join(unknown)}")
    for part, kind in PARTS.items():
        table = values.get(part)
        if not isinstance(table, dict) or type(table.get("name")) is not str:
            raise ConfigError(
                f"{where}: {part} is {str(table)[:80]!r}; expected a table of settings with a name"
            )
        _check_file(where, part, table["name"], folder, files)
        options = {k: v for k, v in table.items() if k != "name"}
        config = settings.from_dict(
            settings_class(kind, table["name"]), options, f"{where}: {part}"
        )
        arguments |= {part: table["name"], f"{part}_config": config}
    return settings.from_dict(RunConfig, arguments, where)


def read(path: Path, files: Sequence[Path] = (), folder: Path | None = None) -> RunConfig:
    """The configuration in a file; arguments as in `from_dict`.

    Raises:
      ConfigError: it cannot be read or is invalid.
    """
    return from_dict(settings.read_json(path), str(path), files, folder)


def changes(old: RunConfig, new: RunConfig) -> Iterator[tuple[str, object, object]]:
    """Settings that differ: name, old and new value; for different plug-ins only those that both
    have.
    """
    before, after = flat(old), flat(new)
    for name, value in before.items():
        if name in after and value != after[name]:
            yield name, value, after[name]


def other(old: RunConfig, new: RunConfig) -> Iterator[tuple[str, object, object]]:
    """Differences that make two configurations different runs: all except those of AT_THE_END."""
    return (change for change in changes(old, new) if change[0] not in AT_THE_END)


def flat(config: RunConfig) -> dict[str, object]:
    """Every setting by its flag's name."""
    out: dict[str, Any] = {}
    for name in _fields(config):
        value = getattr(config, name)
        out |= settings.to_dict(value) if name.endswith("_config") else {name: value}
    return {name.replace("_", "-"): value for name, value in out.items()}


def flags(config: RunConfig) -> list[str]:
    """The flags with which `farm run` takes this configuration."""
    parts = {part: getattr(config, part) for part in PARTS}
    general = configure(parts["task"])
    base = configure(**parts)
    choices = [
        ("task", RunConfig.task, parts["task"]),
        *((part, getattr(general, part), parts[part]) for part in parts),
    ]
    out = {name: new for name, old, new in (*choices, *changes(base, config)) if old != new}
    if config.pilot and SCALE & {name.replace("-", "_") for name in out}:
        out["pilot"] = True  # without this word those leave it out
    return [word for name, value in out.items() for word in flag_words(name, value)]


def flag_words(name: str, value: object) -> list[str]:
    """The words on a command line that give a setting a value; `name` is its flag's."""
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    values = value if isinstance(value, (tuple, list)) else [value]
    return [word for each in values for word in (f"--{name}", str(each))]
