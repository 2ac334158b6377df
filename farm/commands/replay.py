"""`farm replay`: the learnt gait again, at physics rate, into a recording."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import arguments
from farm import scene as scenes
from farm.errors import RunError
from farm.local import check_rerun, simulate
from learner.evaluation import evaluation_jobs
from learner.folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class ReplayCommand:
    """The learnt gait again, at physics rate, into a recording."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path | None = None
    """Recording to write; None: gait.rrd in the run's folder."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ReplayCommand, words, "farm replay")
    check_rerun()
    from learner.recording.recorder import record_replay
    from learner.recording.run import markdown

    folder = RunFolder.open(command.run)
    config = folder.read_config()
    generation, results = simulate(folder, evaluation_jobs(0, 0))
    shown = results[0].trajectory
    if shown is None:
        raise RunError("the simulation gave no trajectory")
    path = command.to or folder.path / "gait.rrd"
    rollout = (f"mean policy after generation {generation}", shown.trajectory())
    try:
        record_replay(
            path, run=folder.name, scene=scenes.load(config.task.object), config=markdown(config), rollouts=[rollout]
        )
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from None
    success = "the gait succeeds" if shown.success else "the gait does not succeed"
    sys.stdout.write(f"return {shown.value:.3f}, {success}\nwritten to {path}; look at it with: farm view {path}\n")
    return 0
