"""Tests how well each grip holds the object for 3 s without a policy; one table.

python benchmarks/grips.py [--object bar] [--pose opposed]
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from farm.errors import ConfigError
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS, POSES
from farm.tasks.finger_gait.holding import CONTROL_PERIOD, TIMESTEP, moved
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Rollouts, whole

SECONDS = (0.0, 0.5, 1.0, 2.0, 3.0)


def main() -> None:
    """Hold each grip, and print the forces and the object's motion."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", default="bar")
    parser.add_argument("--pose", choices=tuple(POSES), default="opposed")
    parser.add_argument(
        "--option",
        default="",
        help=(
            "MJCF option to use instead of the options of the pose: impratio=3 |"
            " noslip_iterations=5"
        ),
    )
    arguments = parser.parse_args()
    name, _, value = arguments.option.partition("=")
    options = {name: value} if name else None
    fingers = " | ".join(f"{finger} [N]" for finger in FINGERS)
    print(
        f"| grip | s after release | {fingers} | drift [mm] | turn [deg] |\n"
        "|---|---|---|---|---|---|---|"
    )
    for grip in GRIPS:
        try:
            show(grip, hold(arguments.object, arguments.pose, grip, options))
        except ConfigError as error:
            print(f"| {grip} | {error} |")


def hold(
    object_name: str, pose: str, grip: str, options: Mapping[str, str] | None = None
) -> Rollouts:
    """A rollout with zero actions: the commands of the start grip do not change."""
    steps = round(SECONDS[-1] / CONTROL_PERIOD)
    config = FingerGaitConfig(
        object=object_name, pose=pose, start_grip=grip, goal_grip=grip, steps=steps
    )
    settings = POSES[pose] if options is None else replace(POSES[pose], options=options)
    task = FingerGait(config, files=model.posed(model.files([object_name], "opposed"), settings))
    sim = Sim(task.engine(lambda model: BatchEngine(model, 1)))

    def play() -> Rollouts:
        task.setup(sim)
        batch = Batch(task, sim, [None], every=1)
        while not batch.over:
            batch.step(np.zeros((1, len(JOINTS))))
        return batch.rollouts()

    rollouts: Rollouts = again(play)
    return rollouts


def show(grip: str, rollouts: Rollouts) -> None:
    """Rows of the table."""
    frames = whole(rollouts, 0)
    pose, force = frames["qpos"][:, len(JOINTS) :], frames["force"].sum(axis=-1)
    for seconds in SECONDS:
        at = round(seconds / TIMESTEP)
        if at < len(pose):
            shift, turn = moved(pose[at], pose[0])
            felt = " | ".join(f"{f:.2f}" for f in force[at])
            first = grip if seconds == 0 else ""
            print(
                f"| {first} | {seconds:g} | {felt} | {1e3 * shift:.2f} | {np.degrees(turn):.2f} |"
            )


if __name__ == "__main__":
    from running import script

    script(main)
