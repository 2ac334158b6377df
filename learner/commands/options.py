"""Options of a learner besides the run's configuration: none of them changes a number."""

import itertools
import re
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, Literal, TypeAlias

from farm import command_line, flags, plugins, settings
from farm.errors import ConfigError
from farm.link import Listening
from farm.net import keys
from farm.net.zenoh_settings import is_port
from farm.settings import Settings, setting
from farm.tasks.base import TaskConfig
from learner.commands.allowed import AllowedFiles, allowed, values_of
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

USUAL: Final = (
    *("task", "policy", "algorithm", "seed", "generations", "preset"),
    *("name", "out", "resume", "workers", "record", "quiet"),
)
"""Settings of a run that `--help` shows; `--help-all` shows all."""

Style: TypeAlias = Literal["auto", "quiet", "json"]
"""Form of the output: a screen or lines, only the end, or one JSON object per line."""

_PART: Final = 30  # characters of a task or a preset in a run's name
_FINGERPRINT: Final = re.compile("[0-9a-f]{8,64}")


@dataclass(frozen=True, kw_only=True)
class LearnerOptions(AllowedFiles, Listening):
    """Where a run starts from, where it is saved, and its network addresses."""

    preset: str | None = None
    """Named settings to start from (farm tasks NAME lists a task's presets).

    By default the task's first preset.
    """
    config: Path | None = None
    """Settings to start from: a config.json (other flags override it)."""
    resume: Path | None = None
    """Continue the run in this folder; --generations may extend it."""
    resume_existing: bool = False
    """Continue the run of that --name if it exists, else start it: for learners restarted by a
    supervisor.
    """
    out: Path = Path("runs")
    """Folder in which run folders are made."""
    name: str = ""
    """Name of the run and its folder; by default task-preset-sSEED-UTC time."""
    record: bool = True
    """Record the run with Rerun."""
    log: tuple[str, ...] = ()
    """Also log the run with tensorboard, wandb or a logger of your own (FILE.py:CLASS), repeatable.
    """
    serve: str | None = None
    """Also stream the recording live, at [HOST:]PORT (host: 127.0.0.1)."""
    listen: str | None = None
    """Where the learner listens for workers.

    By default tcp/127.0.0.1:7447, with farm run any free port.
    """
    any_rounding: bool = False
    """Admit workers whose machines round differently, and resume with changed code: the run is not
    reproducible.
    """
    fingerprint: str = ""
    """A new run accepts machines whose fingerprint begins with these 8 to 64 hexadecimal digits, as
    farm status shows it; by default machines that round like the learner's.
    """
    audit: float = setting(0.02, least=0.0, most=1.0)
    """Share of the other machines' answers that a process of the learner's own repeats; hosts with
    wrong ones are expelled; 0: no checks.
    """
    checker: str = ""
    """Command of the Python that checks, if not the learner's own: of a machine that rounds as the
    run does, such as "ssh HOST PYTHON".
    """
    patience: float = setting(1.0, above=0.0, most=1e6)
    """Least time before a job also goes to a second worker [s]; increase it for slow devices."""
    instances: int = setting(500, least=1, most=10_000)
    """Largest number of workers of one host name, that is of one certificate."""
    compare: bool = True
    """Compare the result with doing nothing and a constant action, if the run validates its
    policies.
    """
    quiet: bool = False
    """Print only warnings and the final result."""
    json: bool = False
    """Print one JSON object per line: the run, each generation, the summary."""
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""

    @property
    def style(self) -> Style:
        """How the run is shown."""
        return "json" if self.json else "quiet" if self.quiet else "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name:
            keys.checked("run", self.name)
        elif self.resume_existing:
            raise ConfigError(
                "--resume-existing needs --name: the name of the run to begin or to continue"
            )
        if self.fingerprint and not _FINGERPRINT.fullmatch(self.fingerprint):
            raise ConfigError(
                f"--fingerprint {self.fingerprint!r}: expected 8 to 64 hexadecimal digits, as farm"
                " status shows"
            )
        if self.quiet and self.json:
            raise ConfigError("--quiet and --json exclude each other")
        if self.listen is not None and self.connect:
            raise ConfigError(
                "--listen and --connect exclude each other: a learner listens, or connects to a"
                " router"
            )
        if self.serve is not None:
            address(self.serve)


def address(serve: str) -> tuple[str, int]:
    """Host and port of [HOST:]PORT; a ConfigError if it has a different form."""
    host, _, port = serve.rpartition(":")
    if not is_port(port):
        raise ConfigError(f"--serve {serve!r} is not of the form [HOST:]PORT, for example 9876")
    return host.strip("[]") or "127.0.0.1", int(port)


def origin(words: Sequence[str]) -> tuple[RunConfig, RunFolder | None]:
    """The configuration that other flags change, and the run to resume.

    Raises:
      ConfigError: two of --preset, --config and --resume, or one that cannot be used.
    """
    sources = {name: _value(words, f"--{name}") for name in ("preset", "config", "resume")}
    names = {part: _value(words, f"--{part}") for part in configs.PARTS}
    parts = {
        part: plugins.find(configs.PARTS[part], name).name
        for part, name in names.items()
        if name is not None
    }
    starts = [f"--{name}" for name, value in sources.items() if value is not None]
    files = allowed(words)
    if len(starts) > 1:
        raise ConfigError(
            f"{' and '.join(starts)} exclude each other: each defines where to start from"
        )
    if sources["resume"] is not None:
        folder = RunFolder.open(Path(sources["resume"]), files)
        return folder.read_config(), folder
    if sources["config"] is not None:
        return configs.changed_by(configs.read(Path(sources["config"]), files), parts), None
    task = parts.pop("task", RunConfig.task)
    return configs.configure(task, sources["preset"], **parts), None


def _value(words: Sequence[str], flag: str) -> str | None:
    """The last value given for a flag; a missing one is left to the parser."""
    return ([None, *values_of(words, flag)])[-1]


def check_resume(saved: RunConfig, config: RunConfig, folder: RunFolder) -> None:
    """Check that a run can continue with this configuration: only its end may change."""
    if changed := list(configs.other(saved, config)):
        what = "; ".join(
            f"--{name} is {old} in the run and {new} here" for name, old, new in changed
        )
        raise ConfigError(
            f"a resumed run keeps its settings: {what}. Only --generations and --average may change"
        )
    last = folder.last_progress()
    done = last.generation if last else 0
    if config.generations < done:
        raise ConfigError(f"--generations {config.generations}: the run has already done {done}")


def run_name(options: LearnerOptions, config: RunConfig) -> str:
    """The new run's name."""
    what = (
        options.config.stem
        if options.config
        else options.preset or next(iter(configs.presets(config.task)))
    )
    task = (
        plugins.find("tasks", config.task)
        .wire.replace(".py:", "-")
        .replace(":", "-")
        .replace("/", "-")
    )
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    # A file's name may have spaces and any letters, and be long
    task, what = (re.sub(r"[^A-Za-z0-9_.-]", "-", each)[:_PART] for each in (task, what))
    name = keys.checked("run", options.name or f"{task}-{what}-s{config.seed}-{stamp}")
    if options.name:
        return name
    # Another run of this second may have that name
    later = (f"{name}-{number}" for number in itertools.count(2))
    return next(
        each for each in itertools.chain([name], later) if not (options.out / each).exists()
    )


def parse(
    kind: type[settings.C], words: Sequence[str], program: str, usual: Collection[str] = USUAL
) -> tuple[settings.C, RunFolder | None, RunConfig]:
    """A command with a RunConfig in its field `run`: preset, file or saved run first, flags over
    it.

    `--help` shows the usual settings, and the command's and the task's own.
    """
    words = flags.long(words)
    base, resumed = origin(words)
    before = configs.pilot_unless(base, given(words))
    default = kind(run=before)  # type: ignore[call-arg]  # it has this field
    names = {*usual, *_own(kind, Settings), *_own(type(base.task_config), TaskConfig)}
    return command_line.parse(kind, words, program, default, usual=names), resumed, base


def _own(kind: type, base: type) -> set[str]:
    """Names of the settings that a class adds to those of a base class."""
    return {each.name for each in fields(kind)} - {each.name for each in fields(base)}


def given(words: Sequence[str]) -> set[str]:
    """Names of the settings whose flags are among the words of a command, with underscores."""
    names = (word.partition("=")[0].removeprefix("--") for word in words if word.startswith("--"))
    return {name.removeprefix("no-").replace("-", "_") for name in names}


def flag(name: str, value: str) -> str:
    """NAME and VALUE as one word of a command line, where the underscores of a setting's name may
    be kept.
    """
    return f"--{name.replace('_', '-')}={value}"
