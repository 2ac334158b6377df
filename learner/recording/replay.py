"""Rollouts in a separate recording, one after the other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from farm.replacing import replacing
from farm.sim.trajectory import Trajectory
from learner.recording import blueprint
from learner.recording.drawing import Drawing
from learner.recording.eye import Eye
from learner.recording.files import compact
from learner.recording.rows import (
    file_sink,
    log_static,
    markdown,
    recording,
    row,
    send,
    send_gaps,
    times,
)

PAUSE: Final = 0.1
"""Pause between two rollouts of a replay [s]."""


def record_replay(
    path: Path,
    *,
    run: str,
    drawing: Drawing,
    config: str,
    rollouts: Sequence[tuple[str, Trajectory]],
) -> None:
    """Write rollouts into a separate file; an existing one is replaced.

    Timelines are sim_time, with a pause after each rollout, and rollout, counted from 1. The
    recording's id is `<run>-replay`; config is the resolved configuration, Markdown. A rollout
    whose return is not a number has none.

    Raises:
      OSError: the file cannot be written; an existing one stays.
    """
    longest = max((float(rollout.times[-1]) for _, rollout in rollouts), default=0.0)
    view = drawing.view([rollout for _, rollout in rollouts])
    layout = blueprint.replay(drawing, Eye.of(view), longest)
    with replacing(path) as aside:
        with recording(f"{run}-replay", [file_sink(aside)], layout) as stream:
            log_static(stream, [*drawing.static(), ("/config", markdown(config))])
            start = 0.0
            for number, (name, rollout) in enumerate(rollouts, 1):
                at = times("rollout", np.array([number]), np.array([start]))
                stream.send_columns("/rollout", at, row(_caption(name, rollout)))
                numbers = np.full(len(rollout.times), number)
                columns = [*drawing.columns(rollout), *drawing.captions([(name, rollout)], view)]
                send(stream, columns, "rollout", numbers, start + rollout.times)
                start += float(rollout.times[-1]) + PAUSE
                if number < len(rollouts):
                    send_gaps(stream, drawing.gaps(1), np.array([start - 0.5 * PAUSE]))
        compact(aside)


def _caption(name: str, rollout: Trajectory) -> rr.TextDocument:
    if not rollout.verdict:
        return markdown(f"### {name}")
    success = {True: ", success", False: ", no success", None: ""}[rollout.success]
    return markdown(f"### {name}\n\n{rollout.verdict}{success}")
