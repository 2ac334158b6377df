"""A script (not a learnt policy) turns a plate by regrasping, from perturbed starts; one table.

    python benchmarks/turning.py [--reach 4,6,8,10] [--cycles 8] [--starts 200] [--video FILE.gif]
        [--torsion 2]

The plate lies on the thumb. Index and middle finger push it in opposite directions; then each of
them is lifted, brought back and set down, while the other holds the plate. The script uses the
model's kinematics but no feedback. Reach and torsional friction are in mm; the video shows the
first reach. Each row has the worst values of all its starts: the least turn and speed, the latest
time, the largest tilt and drift.
"""

import argparse
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from farm import seeds
from farm.arrays import BoolArray, FloatArray
from farm.sim import rendering, video
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS, LOWER, UPPER
from farm.tasks.finger_gait.holding import MAX_SHIFT, TIMESTEP
from farm.tasks.finger_gait.model import Hand
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.finger_gait.turning import Turning, turned, upright
from farm.tasks.loop import again
from farm.tasks.rollouts import Seed

MOST_TILT: Final = 30.0
"""Tilt from which the plate counts as dropped [deg]."""
TURN: Final = 360.0
"""Turn to be reached [deg]."""
SIDE: Final = (264, 216)
"""Width and height of the video [pixels]."""


@dataclass(frozen=True, kw_only=True)
class Script:
    """Parameters of a cycle of the fingers."""

    reach: float = 0.006
    """Distance from the plate's middle at which a stroke begins and ends [m]."""
    press: float = 2.0
    """Commanded force of index and middle finger [N]."""
    thumb: float = 3.0
    """Commanded force of the thumb [N]."""
    pinch: float = 2.5
    """Commanded force of the thumb while one finger is lifted [N]."""
    lift: float = 0.01
    """Height by which a finger is lifted [m]."""
    stroke: float = 0.5
    """Time of a stroke [s]."""
    move: float = 0.1
    """Time of each of: lifting a finger, bringing it back, setting it down [s]."""


class Keys:
    """Computes joint targets for fingertip positions on the plate, by the model's kinematics."""

    def __init__(self, hand: Hand, script: Script) -> None:
        self.script = script
        self._hand, self._data = hand, mujoco.MjData(hand.model)
        grasping = Grasping(hand)
        self._centre, self._touch = grasping.centre, grasping.contact
        self._height = {
            finger: float(self._reached(finger, grasping.contact)[2]) for finger in FINGERS
        }

    def targets(self, index: float, middle: float, lifted: str = "") -> FloatArray:
        """Targets (8,) with the fingers at these offsets along x from the plate's middle, at most
        one lifted.
        """
        script, out = self.script, np.empty(len(JOINTS))
        for finger, along in (("index", index), ("middle", middle)):
            force = 0.0 if finger == lifted else -script.press
            out[FINGER_JOINTS[finger]] = self._at(
                finger, along, script.lift if finger == lifted else 0.0, force
            )
        out[FINGER_JOINTS["thumb"]] = self._at(
            "thumb", 0.0, 0.0, script.pinch if lifted else script.thumb
        )
        return np.clip(out, LOWER, UPPER)

    def _at(self, finger: str, along: float, up: float, force: float) -> FloatArray:
        """A finger's targets at a position, beyond it by J' F / k to press upwards with this
        force.
        """
        joints, hand_model = FINGER_JOINTS[finger], self._hand.model
        goal = np.array([self._centre[0] + along, self._height[finger] + up])
        values, jacobian = self._touch.copy(), np.empty((3, hand_model.nv))
        for _ in range(40):
            error = goal - self._reached(finger, values)[[0, 2]]
            mujoco.mj_jacSite(hand_model, self._data, jacobian, None, self._site(finger))
            plane = jacobian[[0, 2]][:, joints]
            values[joints] += np.linalg.lstsq(plane, error, rcond=None)[0]
        return values[joints] + jacobian[2, joints] * force / hand_model.actuator_gainprm[joints, 0]

    def _reached(self, finger: str, values: FloatArray) -> FloatArray:
        """Position of a fingertip [m]."""
        self._data.qpos[: len(JOINTS)] = values
        mujoco.mj_kinematics(self._hand.model, self._data)
        mujoco.mj_comPos(self._hand.model, self._data)
        return self._data.site_xpos[self._site(finger)].copy()

    def _site(self, finger: str) -> int:
        return self._hand.tip_sites[FINGERS.index(finger)]


def phases(keys: Keys) -> list[tuple[FloatArray, float]]:
    """A cycle: targets, and the time in which each is reached [s]."""
    script, far = keys.script, keys.script.reach
    return [
        (keys.targets(far, -far), script.stroke),
        (keys.targets(far, -far, "index"), script.move),
        (keys.targets(-far, -far, "index"), script.move),
        (keys.targets(-far, -far), script.move),
        (keys.targets(-far, -far, "middle"), script.move),
        (keys.targets(-far, far, "middle"), script.move),
        (keys.targets(-far, far), script.move),
    ]


def script_of(keys: Keys, cycles: int) -> FloatArray:
    """Targets for each physics step, (T, 8): to where a stroke begins, and the cycles."""
    first = (keys.targets(-keys.script.reach, keys.script.reach), keys.script.stroke)
    last, out = keys.targets(0.0, 0.0), []
    for targets, seconds in [first, *phases(keys) * cycles]:
        part = np.arange(1, round(seconds / TIMESTEP) + 1)[:, None] / max(
            1, round(seconds / TIMESTEP)
        )
        out.append(last + (targets - last) * part)
        last = targets
    return np.concatenate(out)


@dataclass(frozen=True)
class Turned:
    """The plate's motion at each physics step after its release, in B rollouts."""

    degrees: FloatArray
    """Turn about the vertical [deg], clockwise seen from above, continuous beyond 360, (B, T)."""
    tilt: FloatArray
    """Tilt of the plate's upright axis [deg], (B, T)."""
    drift: FloatArray
    """Distance of its centre from the point of release [m], (B, T)."""
    lost: BoolArray
    """Whether at this step or earlier no fingertip touched it, or it was out of place, (B, T)."""
    felt: BoolArray
    """Which fingertips touch it, (B, T, 3)."""
    qpos: FloatArray
    """Positions, (B, T, nq)."""

    @classmethod
    def of(cls, qpos: FloatArray, felt: BoolArray) -> "Turned":
        """The motion computed from the states (B, T, nq) and from which fingertips touch the plate
        (B, T, 3).
        """
        pose = qpos[..., -7:]
        degrees = np.cumsum(np.degrees(2.0 * np.arctan(0.5 * turned(pose))), axis=1)
        tilt = np.degrees(np.arccos(np.clip(upright(pose), -1.0, 1.0)))
        drift = np.linalg.norm(pose[..., :3] - pose[:, :1, :3], axis=-1)
        drops = np.maximum.accumulate(
            ~felt.any(axis=-1) | (tilt > MOST_TILT) | (drift > MAX_SHIFT), axis=1
        )
        return cls(np.pad(degrees, ((0, 0), (1, 0))), tilt, drift, drops, felt, qpos)

    def first(self, row: int) -> "Turned":
        """One rollout up to the loss of the plate."""
        steps = (
            max(1, int(np.argmax(self.lost[row]))) if self.lost[row].any() else self.lost.shape[1]
        )
        one = slice(row, row + 1)
        return Turned(*(getattr(self, field.name)[one, :steps] for field in fields(self)))


def task(object_name: str = "plate", torsion: float | None = None) -> FingerGait:
    """The finger gait's hand, three-finger grip and perturbations.

    The object's friction can be changed.
    """
    three = "index+middle+thumb"
    config = FingerGaitConfig(object=object_name, pose="between", start_grip=three, goal_grip=three)
    if torsion is None:
        return FingerGait(config)
    files = model.files([object_name], config.pose)
    thing = ET.fromstring(files["object.xml"])
    for geom in thing.iterfind(".//geom[@friction]"):
        sliding, _, rolling = geom.attrib["friction"].split()
        geom.set("priority", "1")
        geom.set("friction", f"{sliding} {torsion} {rolling}")
    return FingerGait(config, files={**files, "object.xml": ET.tostring(thing, encoding="unicode")})


def turn(gait: FingerGait, targets: FloatArray, starts: Sequence[Seed]) -> Turned:
    """Close the grip at each start, release the plate, and play the targets (T, 8)."""
    sim = Sim(gait.engine(lambda hand_model: BatchEngine(hand_model, len(starts))))

    def played() -> tuple[FloatArray, BoolArray]:
        gait.setup(sim)
        sim.begin(len(starts))
        gait.prepare(
            sim, [None if seed is None else np.random.default_rng(seed) for seed in starts]
        )
        sim.start(np.arange(len(starts)))
        poses, felt = [], []
        for each in targets:
            poses.append(sim.qpos.copy())
            sim.play(each[None])
            felt.append((gait.measure(sim)["force"] > 0).any(axis=-1))
        return np.stack(poses, axis=1), np.stack(felt, axis=1)

    qpos, felt = again(played)
    return Turned.of(qpos, felt)


def main() -> None:
    """Turn the plate, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", default="plate")
    parser.add_argument(
        "--reach", default="6", help="half the length of a stroke [mm]; several separated by commas"
    )
    parser.add_argument(
        "--torsion", type=float, help="torsional friction of the object [mm]; the plate has 2"
    )
    parser.add_argument("--cycles", type=int, default=8)
    parser.add_argument("--starts", type=int, default=200, help="number of perturbed starts")
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="video of the rollout from the nominal start: .gif or .mp4",
    )
    arguments = parser.parse_args()
    if arguments.video is not None:
        video.check(arguments.video)
    gait = task(arguments.object, arguments.torsion and 1e-3 * arguments.torsion)
    print(
        "| reach [mm] | start | turned [deg] | in [s] | deg/s | 360 after [s] | tilt [deg] | drift"
        " [mm] | reached 360 |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for number, reach in enumerate(arguments.reach.split(",")):
        keys = Keys(gait.hand, Script(reach=1e-3 * float(reach)))
        result = turn(
            gait,
            script_of(keys, arguments.cycles),
            [None, *(seeds.evaluation_start(0, i) for i in range(arguments.starts))],
        )
        print(f"| {reach} | nominal | {row(result, slice(0, 1))} |")
        if arguments.starts:
            print(f"| | {arguments.starts} perturbed | {row(result, slice(1, None))} |", flush=True)
        if arguments.video is not None and not number:
            video.write(arguments.video, film(gait, result))


def row(result: Turned, rows: slice) -> str:
    """Cells of the table: least turn and speed, latest time, largest tilt and drift of these
    rollouts.
    """
    each = [result.first(i) for i in range(len(result.lost))[rows]]
    whole = [i for i in each if i.degrees[0].max(initial=0.0) >= TURN]
    degrees = min(i.degrees[0, -1] for i in each)
    seconds = max(i.degrees.shape[1] for i in each) * TIMESTEP
    speed = min(i.degrees[0, -1] / (i.degrees.shape[1] * TIMESTEP) for i in each)
    late = [int(np.argmax(i.degrees[0] >= TURN)) * TIMESTEP for i in whole]
    after = f"{max(late):.1f}" if late else "-"
    tilt, drift = max(i.tilt.max() for i in each), max(1e3 * i.drift.max() for i in each)
    reached = f"{len(whole)} of {len(each)}"
    return (
        f"{degrees:.0f} | {seconds:.1f} | {speed:.0f} | {after} | {tilt:.1f} | {drift:.1f} |"
        f" {reached}"
    )


def film(gait: FingerGait, result: Turned) -> Iterator[rendering.Picture]:
    """Pictures of the first rollout in real time, until the plate has made a full turn."""
    first = result.first(0)
    round_at = np.flatnonzero(first.degrees[0] >= TURN)
    poses = first.qpos[0, : round_at[0] + 1] if len(round_at) else first.qpos[0]
    moments = video.moments((np.arange(len(poses)) * TIMESTEP).tolist(), speed=1.0, rest=0.0)[::2]
    for picture in rendering.pictures(gait.model, poses[moments], SIDE, camera=Turning.camera):
        yield from (picture, picture)  # a gif stores it once


if __name__ == "__main__":
    from running import script

    script(main)
