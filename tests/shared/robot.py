"""A task whose model is files in a folder: an arm with an include, a mesh, a texture and a height
field.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

TASK = '''
from pathlib import Path

import numpy as np
from farm import Task


class Reach(Task):
    """Bring the arm's tip to a ball that moves; something pushes it."""

    xml = Path("robot/scene.xml")
    steps, substeps = 20, 5

    def reset(self, sim, row, rng):
        when = sim.own.setdefault("when", np.zeros(len(sim), dtype=int))
        when[row] = 5 if rng is None else rng.integers(2, 15)

    def act(self, sim, action):
        sim.mocap_pos[:, 0, 2] = 0.3 + 0.01 * sim.t
        sim.body("link").xfrc_applied[sim.own["when"] == sim.t, 0] = 0.5
        return super().act(sim, action)

    def reward(self, sim, action):
        return -np.abs(sim.site("tip").xpos - sim.mocap_pos[:, 0]).sum(axis=1)
'''

SCENE = """<mujoco>
  <compiler assetdir="assets"/>
  <include file="parts/arm.xml"/>
  <asset>
    <texture name="grey" type="2d" file="grey.png"/>
    <material name="grey" texture="grey"/>
    <hfield name="ground" file="ground.bin" size="1 1 0.1 0.1"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="ground" material="grey" pos="0 0 -1"/>
    <body name="ball" mocap="true"><geom size="0.02" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>"""

ARM = """<mujoco>
  <asset><mesh name="link" file="link.stl"/></asset>
  <worldbody><body name="link" pos="0 0 0.1"><joint name="hinge" axis="0 1 0" damping="0.1"/>
    <geom type="mesh" mesh="link" density="300"/><site name="tip" pos="0 0 0.4"/></body></worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>"""


def stl(length: float = 0.4) -> bytes:
    """A box of that length along z as a binary STL: 12 triangles."""
    corners = np.array(
        [[x, y, z] for x in (-0.03, 0.03) for y in (-0.02, 0.02) for z in (0.0, length)]
    )
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [(a, *two) for a, b, c, d in sides for two in ((b, c), (c, d))]
    body = b"".join(
        struct.pack("<3f9fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces
    )
    return bytes(80) + struct.pack("<I", len(faces)) + body


def png() -> bytes:
    """Two by two grey pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0)
    pixels = zlib.compress((b"\0" + b"\x80" * 6) * 2)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def robot(folder: Path) -> Path:
    """Write the task and its robot into a folder; returns the task's file."""
    files: dict[str, str | bytes] = {
        "reach.py": TASK,
        "robot/scene.xml": SCENE,
        "robot/parts/arm.xml": ARM,
        "robot/assets/link.stl": stl(),
        "robot/assets/grey.png": png(),
        "robot/assets/ground.bin": struct.pack("<2i9f", 3, 3, *np.linspace(0.0, 1.0, 9)),
    }
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / "reach.py"
