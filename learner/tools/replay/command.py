"""`farm replay`: simulates any stored policy or any rollout of a run again, for a recording and a
video.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import tyro

from farm import command_line, flags, plugins
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import bar, draw_offscreen
from farm.errors import ConfigError, RunError, writing
from farm.settings import setting
from farm.targets import typed
from farm.tasks.base import Task, TaskConfig
from learner.commands import recordings
from learner.commands.allowed import allowed
from learner.commands.of_run import OfRun
from learner.run.config import MOST_GENERATIONS, RunConfig
from learner.run.folder import RunFolder

if TYPE_CHECKING:
    from learner.tools.replay.loaded import LoadedPolicy, Replay
    from learner.tools.replay.ranked import Ranked

MOST: Final = 12
"""Largest number of rollouts side by side: more would be too small to see."""

MOST_STARTS: Final = 100_000
"""Largest number of starts that are tried."""


@dataclass(frozen=True, kw_only=True)
class ReplayCommand(OfRun):
    """Simulates any policy or rollout of a run again, at physics rate, also with a changed task."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path | None = None
    """Recording to write; by default rollout.rrd in the run's folder."""
    generation: int | None = setting(None, least=0, most=MOST_GENERATIONS)
    """Generation whose mean policy (0: before learning) or whose rollouts are shown; by default
    the run's policy, or the last generation's rollouts."""
    rollout: tuple[int, ...] = ()
    """Show this exploring rollout of the generation, counted from 0; repeatable."""
    seed: tuple[int, ...] = ()
    """Show the policy from this perturbed start, as farm evaluate counts them, from 0; repeatable.
    """
    starts: int | None = setting(None, least=1, most=MOST_STARTS)
    """Try the policy from this number of perturbed starts, and show the worst; or those that the
    next flags choose.
    """
    best: int | None = setting(None, least=1, most=MOST)
    """Show this number of the generation's exploring rollouts, or of --starts, those with the
    highest returns.
    """
    worst: int | None = setting(None, least=1, most=MOST)
    """Show this number of them, those with the lowest returns."""
    video: Path | None = None
    """Also write a video: a name that ends in .gif or .mp4."""
    speed: float = setting(0.25, least=0.01, most=10)
    """Speed of the video: 1 is real time."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the task; the default is the run's own."""
    ended: int | None = None
    """Show this number of rollouts that the task ended.

    The flag's name is the task's word for it, see `_command`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rollout and (self.seed or self.starts):
            raise ConfigError(
                "--rollout is of a generation that explores, --seed and --starts of the policy:"
                " give one"
            )
        if self.seed and not self.starts and any((self.best, self.worst, self.ended)):
            raise ConfigError(
                "--seed with --best, --worst or others: add --starts N, of which they choose"
            )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    config = config_of(words)
    task, kind = (
        (config.task_config, plugins.find("tasks", config.task).target)
        if config
        else (TaskConfig(), Task)
    )
    settings_class = _command(kind.ending)
    default = settings_class(run=tyro.MISSING, task=task)
    command = command_line.parse(settings_class, words, "farm replay", default)
    logs.set_up("WARNING")
    from farm.sim import video
    from learner.recording.files import check_rerun

    check_rerun()
    if command.video is not None:
        video.check(command.video)
    folder = RunFolder.open(command.run, command.allow_file)
    path = recordings.target(command.to or folder.path / "rollout.rrd")
    instead = " in place of an earlier one (--to FILE keeps both)" if path.exists() else ""
    names = [
        each.name
        for each in fields(task)
        if getattr(task, each.name) != getattr(command.task, each.name)
    ]
    changed = ", ".join(f"{name.replace('_', ' ')} {getattr(command.task, name)}" for name in names)
    if command.seed or command.starts:
        policy, names, replays = _starts(command, folder, path, kind.ending, changed)
    elif any((command.rollout, command.best, command.worst, command.ended)):
        policy, names, replays = _rollouts(command, folder, path, kind.ending, changed)
    else:
        policy, names, replays = _mean(command, folder, path, changed)
    say(f"written to {path}{instead}; look at it with: farm view {typed(path)}")
    if command.video is not None:
        films = [
            (name, each.trajectory, each.frames) for name, each in zip(names, replays, strict=True)
        ]
        recordings.film(policy.problem.task, films, command.video, command.speed)
    return 0


def _command(ending: str) -> type[ReplayCommand]:
    """The command with its flag for ended rollouts renamed to the task's word."""
    about = f"Show this number of them that {_were(ending)}, the first ones."
    names = {each.name for each in fields(ReplayCommand)}
    name = Task.ending if ending in names else ending
    flag = Annotated[int | None, tyro.conf.arg(name=name, help=about)]
    return make_dataclass(
        "ReplayCommand",
        [("ended", flag, setting(None, least=1, most=MOST))],
        bases=(ReplayCommand,),
        frozen=True,
        kw_only=True,
        namespace={"__doc__": ReplayCommand.__doc__},
    )


def _were(ending: str) -> str:
    return "the task ended" if ending == Task.ending else ending


def _mean(
    command: ReplayCommand, folder: RunFolder, path: Path, changed: str
) -> tuple["LoadedPolicy", Sequence[str], list["Replay"]]:
    """Show a mean policy."""
    from learner.tools.replay.loaded import loaded

    policy = loaded(folder, command.generation, command.task, last=command.last)
    replay = policy.rollout()
    name = f"mean policy after generation {policy.generation}" + (f", {changed}" if changed else "")
    recordings.record(path, folder.name, policy.problem, name, replay.trajectory)
    say(f"{replay.trajectory.verdict}{_succeeds(replay)}")
    return policy, [name], [replay]


def _succeeds(replay: "Replay") -> str:
    return {True: ", it succeeds", False: ", it does not succeed", None: ""}[
        replay.trajectory.success
    ]


def _rollouts(
    command: ReplayCommand, folder: RunFolder, path: Path, ending: str, changed: str
) -> tuple["LoadedPolicy", Sequence[str], list["Replay"]]:
    """Show exploring rollouts of a generation."""
    from learner.tools.replay.rewind import rewound as of_folder
    from learner.tools.replay.rewind import under

    rewound = of_folder(folder, command.generation)
    # Chosen by the run's own results
    policy = under(folder, rewound, command.task) if changed else rewound.policy
    title = f"generation {rewound.generation}"
    indices = _indices(command, command.rollout, rewound, title, ending)
    replays = rewound.again(indices, policy)
    again = f"`farm replay {typed(command.run)} --generation {rewound.generation} --rollout I`"
    names = [f"rollout {index}" for index in indices]
    title += f", {changed}" if changed else ""
    return policy, _show(path, folder, policy, title, names, replays, again), replays


def _starts(
    command: ReplayCommand, folder: RunFolder, path: Path, ending: str, changed: str
) -> tuple["LoadedPolicy", Sequence[str], list["Replay"]]:
    """Show a mean policy from perturbed starts."""
    from learner.tools.replay.loaded import loaded
    from learner.tools.replay.starts import Starts

    policy = loaded(folder, command.generation, command.task, last=command.last)
    with bar("rollouts", command.starts or 0) as advance:
        starts = Starts.tried(policy, command.starts or 0, advance)
    if command.starts and not any((command.seed, command.best, command.worst, command.ended)):
        command = replace(command, worst=1)
    numbers = _indices(command, command.seed, starts, f"{command.starts} starts", ending)
    replays = starts.again(numbers)
    title = f"mean policy after generation {policy.generation}" + (
        f", {changed}" if changed else ""
    )
    names = [f"start {number}" for number in numbers]
    again = f"`farm replay {typed(command.run)} --seed I`"
    return policy, _show(path, folder, policy, title, names, replays, again), replays


def _show(
    path: Path,
    folder: RunFolder,
    policy: "LoadedPolicy",
    title: str,
    names: Sequence[str],
    replays: Sequence["Replay"],
    again: str,
) -> Sequence[str]:
    """Record rollouts, one by itself, several side by side; say what came out, and how to see
    one.

    Returns their names, which say all of one by itself.
    """
    from learner.recording.comparison import Side, record_comparison
    from learner.recording.drawing import Drawing

    lines = [f"{each.trajectory.verdict}{_succeeds(each)}" for each in replays]
    if len(replays) == 1:
        recordings.record(
            path, folder.name, policy.problem, f"{names[0]} of {title}", replays[0].trajectory
        )
    else:
        drawing = Drawing.of(policy.problem)
        rows = [f"| {name} | {line} |" for name, line in zip(names, lines, strict=True)]
        table = "\n".join(
            [f"### {title} of {folder.name}", "", "| | |", "|---|---|", *rows, "", f"One: {again}"]
        )
        sides = [
            Side(name, drawing, (), each.trajectory)
            for name, each in zip(names, replays, strict=True)
        ]
        with writing(path):
            record_comparison(path, sides, table, rollouts_of=folder.name)
    say(*(f"{title}, {name}: {line}" for name, line in zip(names, lines, strict=True)))
    return names if len(names) > 1 else [f"{names[0]} of {title}"]


def _indices(
    command: ReplayCommand,
    by_index: Sequence[int],
    pool: "Ranked",
    of: str,
    ending: str,
) -> list[int]:
    """Indices of rollouts: given ones, the best, the worst, those that ended.

    Each once, at most MOST.

    Raises:
      ConfigError: too many are requested.
      RunError: none ended.
    """
    ended = pool.ended(command.ended or 0)
    if command.ended and not ended:
        raise RunError(f"no rollout of {of} {ending if ending != Task.ending else 'was ended'}")
    if command.ended and len(ended) < command.ended:
        say(f"{len(ended)} of the {len(pool.returns)} rollouts of {of} {_were(ending)}")
    requests = [*by_index, *pool.best(command.best or 0), *pool.worst(command.worst or 0), *ended]
    indices = list(dict.fromkeys(requests))
    if len(indices) > MOST:
        raise ConfigError(
            f"{len(indices)} rollouts are requested; at most {MOST} are shown side by side"
        )
    return indices


def config_of(words: Sequence[str]) -> RunConfig | None:
    """The configuration of the run in the words, for its task's flags; None without one.

    Raises:
      ConfigError: the first word is not a run's folder.
    """
    for word in words:
        if not word.startswith("-") and (Path(word) / "config.json").is_file():
            return RunFolder(Path(word), allowed(words)).read_config()
    if words and not words[0].startswith("-") and not {*flags.HELP} & set(words):
        # Raises first: otherwise its task's flags would be reported as unknown
        RunFolder.open(Path(words[0]))
    return None
