"""How well the grips hold by themselves: each is closed, released and left alone for 3 s; one table.

python benchmarks/grips.py [--object bar]
"""

import argparse

import numpy as np

from farm.policies.fourier import Features, Policy, PolicyConfig
from farm.tasks.finger_gait.hand import FINGERS
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.physics import Simulation
from farm.tasks.finger_gait.task import TIMESTEP, TaskConfig, moved

SECONDS = (0.0, 0.5, 1.0, 2.0, 3.0)


def main() -> None:
    """Hold, and print what was felt and how far the object went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="bar")
    arguments = parser.parse_args()
    fingers = " | ".join(f"{finger} [N]" for finger in FINGERS)
    print(f"| grip | s after release | {fingers} | drift [mm] | turn [deg] |\n|---|---|---|---|---|---|---|")
    for grip in ("index+thumb", "index+middle+thumb"):
        hold(arguments.object, grip)


def hold(object_name: str, grip: str) -> None:
    """A rollout of a controller that always says zero: the start grip's commands stay as they are."""
    steps = round(SECONDS[-1] / 0.1)
    config = TaskConfig(object=object_name, start_grip=grip, steps=steps)
    kernel = PolicyConfig(controller="kernel")
    size = STATES[config.state].size
    policy = Policy(kernel, size, Features.draw(kernel, size, np.random.default_rng(0)))
    far = np.full((1, policy.size), 50.0)  # so far from any joint position that the kernel is zero
    rollouts = Simulation(config, policy).run(far, [None], substeps=1)
    start = rollouts.start.pose
    held = rollouts.outcome.steps[0] * 0.1
    for seconds in (s for s in SECONDS if s <= held):
        frames = rollouts.start if seconds == 0 else rollouts.frames
        at = () if seconds == 0 else (round(seconds / TIMESTEP) - 1,)
        force = frames.force[(0, *at)].sum(axis=-1)
        shift, turn = moved(frames.pose[(0, *at)], start[0])
        felt = " | ".join(f"{f:.2f}" for f in force)
        print(f"| {grip if seconds == 0 else ''} | {seconds:g} | {felt} | {1e3 * shift:.2f} | {np.degrees(turn):.2f} |")


if __name__ == "__main__":
    main()
