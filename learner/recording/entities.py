"""Paths of what a scene shows: an entity of its own for each body and geometry, whatever its name
is.
"""

from collections.abc import Sequence
from typing import Final

import rerun as rr

from farm.sim.channels import Channel
from farm.sim.scene import Geometry, Scene, distinct

CAPTION: Final = "/world/caption"
"""Entity of the text in the scene."""

FOLLOWED: Final = "/world/view"
"""Entity that the eye follows, an invisible point: a body without a geometry of its own cannot be
followed.
"""


def path(name: str) -> str:
    """Convert a name that may contain slashes to an entity's path."""
    return "".join(f"/{rr.escape_entity_path_part(part)}" for part in name.split("/"))


class SceneEntities:
    """The entities of a scene: /world/BODY, and /world/BODY/GEOM.

    A name that a channel or the scene's text has as well, or an unnamed geometry, gets a _ behind
    it.
    """

    def __init__(self, scene: Scene, channels: Sequence[Channel]) -> None:
        """Choose them, for a scene with a task's channels."""
        parts_of_channels = {channel.name.partition("/")[0] for channel in channels}
        fixed = {each.rpartition("/")[2] for each in (CAPTION, FOLLOWED)}
        names = distinct(scene.bodies, parts_of_channels | fixed)
        self.bodies = tuple(f"/world/{rr.escape_entity_path_part(name)}" for name in names)
        """Entities of the bodies, in the order of `scene.bodies`."""
        self.geometries: list[tuple[str, Geometry]] = []
        """Everything to draw, with its entity."""
        by_body: dict[str, list[Geometry]] = {body: [] for body in scene.bodies}
        for geometry in scene.geometries():
            by_body[geometry.body].append(geometry)
        for entity, its in zip(self.bodies, by_body.values(), strict=True):
            parts = distinct([geometry.name for geometry in its], parts_of_channels)
            for geometry, part in zip(its, parts, strict=True):
                self.geometries.append((f"{entity}/{rr.escape_entity_path_part(part)}", geometry))
