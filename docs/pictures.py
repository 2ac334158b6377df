"""Makes the pictures of the documentation that come from the code itself.

    MUJOCO_GL=egl python docs/pictures.py [--out docs/pictures] [--run runs/NAME]

hand.png: the hand waiting, in the start grip, in the goal grip. tactile.svg: where the taxels are,
and what one contact gives. gait.gif, with --run: a run's first and last policy, from `farm run
--seed 0`. (viewer.png is the Rerun viewer on a run's recording.) Needs the extra `video`.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from farm.arrays import FloatArray
from farm.sim import rendering, video
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks import loop
from farm.tasks.finger_gait import touch
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import JOINTS, TIP_RADIUS
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from learner.tools.replay.loaded import LoadedPolicy, Replay, load

PANEL: Final = (400, 450)
"""Width and height of one hand [pixels]."""

SIDE: Final = (400, 340)
"""Width and height of one hand of the animation [pixels]."""

_RAMP: Final = np.array(
    [[68, 1, 84], [59, 81, 139], [33, 144, 141], [93, 200, 99], [253, 231, 37]], dtype=float
)


def main() -> None:
    """Make them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "pictures")
    parser.add_argument("--run", type=Path)
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    (out / "tactile.svg").write_text(tactile_picture(), "utf-8")
    hand_picture().save(out / "hand.png", optimize=True)
    if arguments.run is not None:
        video.write(out / "gait.gif", gait_video(arguments.run))


def hand_picture() -> Image.Image:
    """Three moments side by side."""
    poses = [("waiting", _waiting()), *((grip.replace("+", " + "), _held(grip)) for grip in _HELD)]
    width, height = PANEL
    picture = Image.new("RGB", (width * len(poses), height))
    pen = ImageDraw.Draw(picture)
    for i, (name, qpos) in enumerate(poses):
        picture.paste(_photograph(qpos), (i * width, 0))
        pen.text(
            (i * width + width // 2, height - 26),
            name,
            (40, 44, 52),
            ImageFont.load_default(20),
            anchor="mm",
        )
    return picture


_HELD: Final = ("index+thumb", "index+middle+thumb")


def _waiting() -> FloatArray:
    """Fingers open, the object frozen in front of them, (15,)."""
    hand = FingerGait().hand
    qpos = hand.model.qpos0.copy()
    qpos[: len(JOINTS)] = Grasping(hand).command(())
    return qpos


class _Still:
    """A policy whose actions are zero."""

    def prepare(self, theta: FloatArray) -> FloatArray:
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:  # noqa: ARG002
        return np.zeros((len(prepared), len(JOINTS)))


def _held(grip: str) -> FloatArray:
    """One second after the release from a grip that is left alone, (15,)."""
    task = FingerGait(FingerGaitConfig(start_grip=grip))
    sim = Sim(task.engine(BatchEngine))
    loop.again(lambda: task.setup(sim))
    rollouts = loop.run(task, _Still(), sim, np.zeros((1, 1)), [None])
    return rollouts.frames["qpos"][0, 9]


def _photograph(qpos: FloatArray) -> Image.Image:
    camera = replace(FingerGait.camera, distance=0.4)
    (picture,) = rendering.pictures(FingerGait().model, qpos[None], PANEL, camera=camera)
    return Image.fromarray(picture)


def gait_video(run: Path) -> Iterator[rendering.Picture]:
    """The run's first and last policy beside each other, a third of real time."""
    policies = {
        "before learning": load(run, generation=0),
        "after learning": load(run),
    }
    replays = {name: policy.rollout() for name, policy in policies.items()}
    longest = max((replay.trajectory.times for replay in replays.values()), key=len)
    schedule = video.moments(longest.tolist(), speed=1 / 3, rest=1.5)
    sides = []
    for name, policy in policies.items():
        rows = [min(moment, len(replays[name].trajectory.times) - 1) for moment in schedule]
        moments = sorted(set(rows))
        frames = dict(zip(moments, _drawn(policy, replays[name], moments), strict=True))
        sides.append([_named(frames[row], name) for row in rows])
    return (np.concatenate(pair, axis=1) for pair in zip(*sides, strict=True))


def _drawn(policy: LoadedPolicy, replay: Replay, moments: list[int]) -> Iterator[rendering.Picture]:
    """Moments of a rollout."""
    task = policy.problem.task
    values = {name: frames[moments] for name, frames in replay.trajectory.channels.items()}
    return rendering.pictures(
        task.model,
        replay.frames["qpos"][moments],
        SIDE,
        camera=task.camera,
        channels=task.channels,
        values=values,
    )


def _named(picture: rendering.Picture, name: str) -> rendering.Picture:
    """A caption below the hand."""
    image = Image.fromarray(picture)
    at = SIDE[0] // 2, SIDE[1] - 20
    ImageDraw.Draw(image).text(at, name, (40, 44, 52), ImageFont.load_default(18), anchor="mm")
    return np.asarray(image)


def tactile_picture() -> str:
    """Side view with the rows' angles, front view with numbered taxels, and the image of one
    contact.
    """
    contact = _direction(np.deg2rad(14.0), np.deg2rad(20.0))
    force = touch.image(np.array([2.0]), contact[None] * TIP_RADIUS)
    parts = [
        (
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 960 400" font-family="DejaVu'
            ' Sans, Arial, sans-serif">'
        ),
        '<rect width="960" height="400" fill="#ffffff"/>',
        *_side(170, 215, 105),
        *_front(470, 215, 130, force, contact),
        *_image(740, 85, force),
        "</svg>\n",
    ]
    return "\n".join(parts)


def _direction(pitch: float, across: float) -> FloatArray:
    """From the fingertip's centre, by angles as in finger_gait/touch.py; pitch from the half
    sphere's middle.
    """
    turned = pitch + touch.TILT
    return np.array(
        [np.cos(across) * np.sin(turned), np.sin(across), np.cos(across) * np.cos(turned)]
    )


def _side(x: float, y: float, radius: float) -> list[str]:
    """In the finger's plane: its axis up, its pad to the right."""
    out = [_title(x, "side view: rows 1 to 6")]
    half = np.deg2rad(np.linspace(-90, 90, 61)) + touch.TILT
    edge = " ".join(f"{x + radius * np.sin(a):.1f},{y - radius * np.cos(a):.1f}" for a in half)
    width = 0.8 * radius
    link = f'x="{x - width:.1f}" y="{y}" width="{2 * width:.1f}" height="{1.25 * radius:.1f}"'
    out.append(f'<rect {link} rx="8" fill="#e3e5e8"/>')
    out.append(f'<circle cx="{x}" cy="{y}" r="{radius}" fill="#f2f3f5" stroke="#b6bac2"/>')
    out.append(f'<polygon points="{edge}" fill="#cfe3f3" stroke="#5b7f9c" stroke-width="1.5"/>')
    out.append(_line(x, y, x, y - 1.3 * radius, "#8a8f98", dashed=True))
    middle = float(touch.TILT)
    out.append(
        _line(x, y, x + 1.2 * radius * np.sin(middle), y - 1.2 * radius * np.cos(middle), "#d55e00")
    )
    out.append(_text(x - 8, y - 1.24 * radius, "finger's axis, z", anchor="end", colour="#5c6068"))
    out.append(
        _text(
            x + 0.66 * radius,
            y - 1.1 * radius,
            f"{np.rad2deg(middle):.0f}°: middle",
            colour="#d55e00",
        )
    )
    for row, angle in enumerate(touch.ROWS, 1):
        a = float(angle) + middle
        out.append(_dot(x + radius * np.sin(a), y - radius * np.cos(a), 5, "#0072b2"))
        out.append(
            _text(
                x + 1.2 * radius * np.sin(a),
                y - 1.2 * radius * np.cos(a) + 5,
                str(row),
                anchor="middle",
            )
        )
    out.append(_text(x - 0.74 * radius, y + 0.95 * radius, "back"))
    out.append(_text(x + 0.74 * radius, y + 0.95 * radius, "pad, x", anchor="end"))
    return out


def _front(x: float, y: float, radius: float, force: FloatArray, contact: FloatArray) -> list[str]:
    """Looking at the middle of the half sphere from outside: towards the finger's back up, positive
    y right.
    """
    out = [_title(x, "front view: taxels 0 to 17")]
    out.append(
        f'<circle cx="{x}" cy="{y}" r="{radius}" fill="#eef4f9" stroke="#5b7f9c"'
        ' stroke-width="1.5"/>'
    )
    tilt = float(touch.TILT)
    back = np.array([-np.cos(tilt), 0.0, np.sin(tilt)])
    for number, taxel in enumerate(touch.DIRECTIONS):
        at = x + radius * taxel[1], y - radius * float(taxel @ back)
        out.append(_dot(*at, 11.5, _colour(force[number], force.max()), "#30343b"))
        ink = _ink(force[number], force.max())
        out.append(_text(at[0], at[1] + 5, str(number), anchor="middle", colour=ink, size=12))
    cx, cy = x + radius * contact[1], y - radius * float(contact @ back)
    for a, b in (((-7, -7), (7, 7)), ((-7, 7), (7, -7))):
        out.append(_line(cx + a[0], cy + a[1], cx + b[0], cy + b[1], "#d00000", width=4))
    out.append(_text(x, y - radius - 10, "back of the finger", anchor="middle", colour="#5c6068"))
    out.append(_text(x, y + radius + 22, "pad", anchor="middle", colour="#5c6068"))
    out.append(_text(x, y + radius + 44, "x: a contact of 2 N", anchor="middle", colour="#d00000"))
    return out


def _image(x: float, y: float, force: FloatArray) -> list[str]:
    """The 6 x 3 image that comes of it."""
    wide, high = 64, 44
    rows, columns = touch.SHAPE
    out = [_title(x + wide * columns / 2, "its image: 6 x 3 forces [N]")]
    for number, newton in enumerate(force):
        row, column = divmod(number, columns)
        left, top = x + column * wide, y + row * high
        fill = _colour(newton, force.max())
        out.append(
            f'<rect x="{left}" y="{top}" width="{wide}" height="{high}" fill="{fill}"'
            ' stroke="#ffffff"/>'
        )
        ink = _ink(newton, force.max())
        out.append(
            _text(left + wide / 2, top + high / 2 + 5, f"{newton:.2f}", anchor="middle", colour=ink)
        )
    bottom = y + rows * high
    out.append(_text(x, bottom + 22, "negative y", colour="#5c6068"))
    out.append(_text(x + wide * columns, bottom + 22, "positive y", anchor="end", colour="#5c6068"))
    for row, name in ((0, "back"), (rows - 1, "pad")):
        out.append(
            _text(x - 10, y + row * high + high / 2 + 5, name, anchor="end", colour="#5c6068")
        )
    return out


def _title(x: float, text: str) -> str:
    return f'<text x="{x}" y="32" text-anchor="middle" font-size="17" fill="#20242b">{text}</text>'


def _text(
    x: float, y: float, text: str, *, anchor: str = "start", colour: str = "#30343b", size: int = 14
) -> str:
    where = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}"'
    return f'<text {where} fill="{colour}">{text}</text>'


def _dot(x: float, y: float, radius: float, colour: str, stroke: str = "none") -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}" stroke="{stroke}"/>'


def _line(
    x: float,
    y: float,
    to_x: float,
    to_y: float,
    colour: str,
    *,
    width: int = 2,
    dashed: bool = False,
) -> str:
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" '
        f'stroke="{colour}" stroke-width="{width}"{dashes}/>'
    )


def _colour(value: float, top: float) -> str:
    knots = np.linspace(0.0, 1.0, len(_RAMP))
    red, green, blue = (round(float(np.interp(value / top, knots, channel))) for channel in _RAMP.T)
    return f"#{red:02x}{green:02x}{blue:02x}"


def _ink(value: float, top: float) -> str:
    return "#ffffff" if value / top < 0.55 else "#101010"


if __name__ == "__main__":
    main()
