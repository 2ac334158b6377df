"""Shared by commands for recordings: how to watch a run live, which files to open, where one may be
written.
"""

import itertools
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from farm.arrays import FloatArray
from farm.commands.logs import say
from farm.commands.screen import bar
from farm.errors import ConfigError, writing
from farm.replacing import replacing
from farm.targets import check_target
from learner.run.folder import like

if TYPE_CHECKING:
    from farm.sim.rendering import Picture
    from farm.sim.trajectory import Trajectory
    from farm.tasks.base import Task
    from learner.run.setup import Problem

_MAGIC: Final = b"RRF"  # first bytes of a recording of any release of Rerun


def look_on(uri: str) -> list[str]:
    """Say how to open a live stream: here, and on another machine if it listens only here."""
    address = urlsplit(uri)
    lines = [f"live: farm view {uri}   (--web for a browser)"]
    if address.hostname in ("127.0.0.1", "::1", "localhost"):
        tunnel = f"ssh -L {address.port}:127.0.0.1:{address.port} {socket.gethostname()}"
        lines.append(f"from another machine: {tunnel}, and the same there")
    return lines


def sources(what: str) -> list[str]:
    """Files or addresses to open for a run's folder, a recording, or a live stream; else a
    ConfigError.
    """
    from learner.recording.files import parts

    if urlsplit(what).scheme in ("rerun", "rerun+http", "rerun+https"):
        return [what]
    path = Path(what)
    if not path.is_file():
        files = parts(path / "run.rrd")
        if not files:
            near = "" if path.exists() else like(path)  # else its name is no mistake
            raise ConfigError(f"no recording in {path}: give a run's folder or a .rrd file{near}")
        return [str(file) for file in files]
    try:
        with path.open("rb") as file:
            head = file.read(len(_MAGIC))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    if head != _MAGIC:
        raise ConfigError(f"{path} is not a recording: give a run's folder or a .rrd file")
    return [what]


def target(path: Path) -> Path:
    """Check that a recording may be written to a file: it ends in .rrd, its parents are folders,
    and it is not a run's own recording.

    Raises ConfigError otherwise, before any work is done.
    """
    if path.suffix != ".rrd":
        raise ConfigError(f"--to {path}: a recording's name ends in .rrd")
    check_target("--to", path)
    of_run = path.name in ("replay.rrd", "undone.rrd") or path.name.startswith("run.")
    if of_run and (path.parent / "config.json").exists():
        raise ConfigError(f"--to {path} would replace the run's own recording: take another name")
    return path


def record(path: Path, run: str, problem: "Problem", name: str, rollout: "Trajectory") -> None:
    """Write a recording of one rollout with its name; a RunError if that fails."""
    from learner.recording.drawing import Drawing
    from learner.recording.replay import record_replay
    from learner.recording.run import markdown

    with writing(path):
        record_replay(
            path,
            run=run,
            drawing=Drawing.of(problem),
            config=markdown(problem.config),
            rollouts=[(name, rollout)],
        )


def film(
    task: "Task",
    rollouts: "Sequence[tuple[str, Trajectory, Mapping[str, FloatArray]]]",
    path: Path,
    speed: float,
) -> None:
    """Write a video of rollouts side by side, each with its name and its measured frames; one that
    ended early stands still. A bar on the terminal shows how far it is.
    """
    from farm.sim import video

    longest = max((rollout for _, rollout, _ in rollouts), key=lambda each: len(each.times))
    moments = video.moments(longest.times.tolist(), speed, rest=1.0)
    with bar("drawing", len(rollouts) * len(moments)) as advance:
        films = [
            video.captioned(
                _pictures(task, rollout, frames, moments, advance), rollout.caption(name)
            )
            for name, rollout, frames in rollouts
        ]
        write_film(path, map(video.tiled, zip(*films, strict=True)))
    say(f"video: {path}")


def write_film(path: Path, pictures: "Iterable[Picture]") -> None:
    """Write a video of pictures.

    Raises:
      RunError: the file cannot be written; an existing one stays.
    """
    from farm.sim import video

    with writing(path), replacing(path) as aside:
        video.write(aside, pictures)


def _pictures(
    task: "Task",
    rollout: "Trajectory",
    frames: "Mapping[str, FloatArray]",
    moments: Sequence[int],
    advance: Callable[[int], None],
) -> "Iterator[Picture]":
    """One picture per moment, in their order, with its bars; `advance` is called with the number of
    moments that are done.
    """
    from farm.sim import rendering, video
    from farm.sim.scene import MODEL
    from farm.tasks import disturbances

    last, which = len(rollout.times) - 1, rollout.channels.get(MODEL)
    arrows = [channel for channel in disturbances.channels(task) if channel.kind == "arrows"]
    model = task.model if which is None else task.simulated[int(which[0].argmax())]
    unique = sorted({min(moment, last) for moment in moments})
    channels = (*task.channels, *arrows)
    values = {name: each[unique] for name, each in rollout.channels.items()}
    pictures = rendering.pictures(
        model,
        frames["qpos"][unique],
        video.SIZE,
        camera=task.camera,
        channels=channels,
        mocap=frames["mocap"][unique] if "mocap" in frames else None,
        values=values,
    )
    shown_in = Counter(min(moment, last) for moment in moments)
    for moment, picture in zip(unique, video.barred(pictures, channels, values), strict=True):
        yield from itertools.repeat(picture, shown_in[moment])
        advance(shown_in[moment])
