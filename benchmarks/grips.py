"""How well the grips hold by themselves: each is closed, released and left alone for 3 s; one table.

python benchmarks/grips.py [--object bar]
"""

import argparse

import numpy as np

from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait.hand import FINGERS, JOINTS
from farm.tasks.finger_gait.task import CONTROL_PERIOD, TIMESTEP, FingerGait, FingerGaitConfig, moved
from farm.tasks.loop import Batch, Rollouts, again, whole

SECONDS = (0.0, 0.5, 1.0, 2.0, 3.0)


def main() -> None:
    """Hold, and print what was felt and how far the object went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="bar")
    arguments = parser.parse_args()
    fingers = " | ".join(f"{finger} [N]" for finger in FINGERS)
    print(f"| grip | s after release | {fingers} | drift [mm] | turn [deg] |\n|---|---|---|---|---|---|---|")
    for grip in ("index+thumb", "index+middle+thumb"):
        show(grip, hold(arguments.object, grip))


def hold(object_name: str, grip: str) -> Rollouts:
    """A rollout whose actions are zero: the start grip's commands stay as they are."""
    config = FingerGaitConfig(object=object_name, start_grip=grip, steps=round(SECONDS[-1] / CONTROL_PERIOD))
    task = FingerGait(config)
    sim = Sim(task.engine(lambda model: BatchEngine(model, 1)))

    def held() -> Rollouts:
        task.setup(sim)
        batch = Batch(task, sim, [None], every=1)
        while not batch.over:
            batch.step(np.zeros((1, len(JOINTS))))
        return batch.rollouts()

    rollouts: Rollouts = again(held)
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
            print(f"| {first} | {seconds:g} | {felt} | {1e3 * shift:.2f} | {np.degrees(turn):.2f} |")


if __name__ == "__main__":
    main()
