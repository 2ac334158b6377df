"""The model of the hand with an object: its files, and indices into its arrays."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import mujoco

import farm
from farm.errors import ConfigError
from farm.sim.model_files import decoded
from farm.tasks.finger_gait.hand import FINGERS, POSES, Pose
from farm.tasks.finger_gait.markup import tree

CONTACTS: Final = 4
"""Contacts kept per fingertip (the strongest); a sphere on a convex body has one."""

CONTACT_WIDTH: Final = 7
"""Numbers per contact: found (1), force in the contact frame (3) [N], position in the world (3)
[m].
"""

OBJECT: Final = "object"
_TURNS: Final = {"euler": 0, "axisangle": 3}
_OF_HINGES: Final = {"range": 0, "ref": 0, "springref": 0}
"""MJCF's attributes with angles, of all elements and of hinges and balls: the index of the first
angle in each.
"""


def folder() -> Path:
    """The folder of assets: next to this package in a checkout, inside it if installed."""
    inside = Path(farm.__file__).parent / "assets"
    return inside if inside.is_dir() else inside.parent.parent / "assets"


def objects() -> list[str]:
    """Names of the available objects, one file each."""
    return sorted(file.stem for file in folder().glob("objects/*.xml"))


def files(names: Sequence[str], pose: str, stiffness: float = 1.0) -> dict[str, str]:
    """The files of the model by name: hand, the task's additions, and objects given by name or
    file, at least one.

    Hand and objects are set up for a pose, one of POSES; the servos' stiffness is multiplied by a
    factor.

    Raises:
      ConfigError: an object does not exist.
    """
    parts = {name: (folder() / name).read_text("utf-8") for name in ("hand.xml", "finger_gait.xml")}
    bodies = {object_file(i): _object(name) for i, name in enumerate(names)}
    return posed({**parts, **bodies}, POSES[pose], stiffness)


def object_file(index: int) -> str:
    """Name of the file of one of several objects; that of the first is object.xml."""
    return f"object-{index + 1}.xml" if index else "object.xml"


def _object(name: str) -> str:
    names = objects()
    path = Path(name) if name.endswith(".xml") else folder() / f"objects/{name}.xml"
    if not name.endswith(".xml") and name not in names:
        raise ConfigError(
            f"unknown object {name!r}; known are {', '.join(names)}, or a file NAME.xml"
        )
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"cannot read the object {path}: {error}") from None


def posed(sources: Mapping[str, str], pose: Pose, stiffness: float = 1.0) -> dict[str, str]:
    """The files with links turned, the objects placed for a pose, and the servos' stiffness
    multiplied by a factor.
    """
    hand, out = _parsed(sources, "hand.xml"), dict(sources)
    if pose.turned or pose.options or stiffness != 1.0:
        for name, quat in pose.turned.items():
            _body(hand, name).set("quat", quat)
        hand.find("option").attrib.update(pose.options)  # type: ignore[union-attr]
        if stiffness != 1.0:
            servo: ET.Element = hand.find("default/position")  # type: ignore[assignment]
            servo.set("kp", repr(stiffness * float(servo.attrib["kp"])))
        out["hand.xml"] = ET.tostring(hand, encoding="unicode")
    for file in (name for name in sources if name.startswith(OBJECT)):
        thing = _parsed(sources, file)
        changed = _in_radians(thing)
        if pose.place is not None:
            _body(thing, OBJECT).set("pos", pose.place)
        if changed or pose.place is not None:
            out[file] = ET.tostring(thing, encoding="unicode")
    return out


def _in_radians(thing: ET.Element) -> bool:
    """Convert an object's angles from degrees, MuJoCo's default, to the radians of the hand.

    Whether there are any.
    """
    compilers = thing.findall("compiler")
    if any(compiler.get("angle") == "radian" for compiler in compilers):
        return False
    any_angle = bool(compilers)
    for element in thing.iter():
        hinge = element.tag == "joint" and element.get("type", "hinge") in ("hinge", "ball")
        for name, first in (_TURNS | _OF_HINGES if hinge else _TURNS).items():
            numbers = element.get(name, "").split()
            with suppress(ValueError):  # MuJoCo says what is wrong with it
                angles = [repr(math.radians(float(number))) for number in numbers[first:]]
                if angles:
                    element.set(name, " ".join([*numbers[:first], *angles]))
                    any_angle = True
    if any_angle:
        for compiler in compilers or [ET.SubElement(thing, "compiler")]:
            compiler.set("angle", "radian")
    return any_angle


def _body(root: ET.Element, name: str) -> ET.Element:
    for body in root.iter("body"):
        if body.get("name") == name:
            return body
    raise ConfigError(
        f"the hand's model has no body {name!r}: an object's file has a body called {OBJECT!r}"
    )


def _parsed(sources: Mapping[str, str], name: str) -> ET.Element:
    try:
        return tree(sources[name])
    except (KeyError, ValueError) as error:
        raise ConfigError(f"the hand's model: {name} cannot be read: {error}") from None


def mjcf(sources: Mapping[str, str], thing: str = "object.xml", name: str = "") -> str:
    """The texts of `files` with one object as one MJCF text that needs no other file, a model of
    this name.

    Raises:
      ConfigError: a text cannot be read.
    """
    whole = ET.Element("mujoco", {"model": name} if name else {})
    for part in ("hand.xml", "finger_gait.xml", thing):
        whole.extend(_parsed(sources, part))
    return ET.tostring(whole, encoding="unicode")


def texts(sources: Mapping[str, str], names: Sequence[str]) -> list[str]:
    """One such text for each of several objects, models of their names."""
    return [mjcf(sources, object_file(i), Path(name).stem) for i, name in enumerate(names)]


@dataclass(frozen=True)
class Hand:
    """A compiled hand with one object.

    While equality 0, a weld to the mocap body `anchor`, is active, the object is frozen. Its free
    joint is the last in `qpos`, after the eight controlled joints.
    """

    model: mujoco.MjModel
    object_name: str
    pose: Pose = POSES["opposed"]

    @cached_property
    def object_body(self) -> int:
        """The object's body."""
        return int(self.model.body(OBJECT).id)

    @cached_property
    def tip_sites(self) -> list[int]:
        """The sites at the centres of the fingertips, in the order of FINGERS."""
        return [int(self.model.site(f"{finger}_tip").id) for finger in FINGERS]

    @cached_property
    def tip_geoms(self) -> list[int]:
        """The fingertips' spheres, in the order of FINGERS."""
        return [int(self.model.geom(f"{finger}_tip").id) for finger in FINGERS]

    @cached_property
    def object_geoms(self) -> list[int]:
        """The geometries of the object."""
        return [i for i in range(self.model.ngeom) if self.model.geom_bodyid[i] == self.object_body]
