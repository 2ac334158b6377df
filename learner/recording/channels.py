"""A task's channels in Rerun, a class per kind: what is logged once, columns for a rollout's
frames, and views.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import rerun as rr

from farm.arrays import AnyArray, FloatArray, IntArray
from farm.sim.channels import Channel
from farm.sim.marks import ARROW_RADIUS, POINT_RADIUS
from farm.sim.scene import Scene
from farm.tasks.base import TaskSpec
from learner.recording.curves import Columns, lighter, lines, pack, palette, ramp, scalars
from learner.recording.entities import SceneEntities, path
from learner.recording.solids import rotate

STATES: Final = ("off", "on")
"""Names of a flag's values."""

_TEXT: Final = (230, 230, 230)
_SHADES: Final = 32  # of a scale
_OFF: Final = (52, 54, 58)
_ARROW: Final = (255, 255, 255)  # of arrows without colours


class Panel(NamedTuple):
    """A view beside the scene."""

    kind: Literal["curves", "lanes", "picture"]
    origin: str
    name: str
    legend: Sequence[str] = ()
    """Entries of its legend."""


class ChannelDrawing:
    """How one channel is drawn: a subclass for each kind."""

    def __init__(self, channel: Channel, scene: Scene, within: SceneEntities) -> None:
        self.channel = channel
        self.on = [within.bodies[scene.index(body)] for body in channel.bodies]
        """Entities of its bodies."""
        self.entity = path(channel.name)
        self.size = scene.radius
        self.bodies = [scene.index(body) for body in channel.bodies]

    def static(self) -> Iterator[tuple[str, Any]]:
        """Entities and archetypes that are logged once."""
        yield from ()

    def columns(
        self, values: FloatArray, bodies: FloatArray, begins: IntArray
    ) -> Iterator[Columns]:
        """A rollout's frames, or those of several that are joined.

        Args:
          values: (F, *shape) of the channel.
          bodies: (F, B, 7) poses of the drawn bodies [m], quaternions wxyz.
          begins: (F,) number of the rollout that the frame belongs to.
        """
        raise NotImplementedError

    def curves(self) -> Mapping[str, int]:
        """Number of curves of each of the channel's entities that has curves."""
        return {}

    @classmethod
    def panels(cls, channel: Channel, *, alone: bool) -> Sequence[Panel]:  # noqa: ARG003
        """Views of a channel beside the scene; `alone`: no other channel is of its kind."""
        return ()

    def in_world(self, places: FloatArray, bodies: FloatArray) -> FloatArray:
        """Convert positions in the frames of the channel's bodies to the world's (F, n, 3)."""
        if not self.bodies:
            return places
        poses = bodies[:, self.bodies]
        return poses[..., :3] + rotate(poses[..., 3:], places)


class Scalars(ChannelDrawing):
    """Curves at /NAME, and their limits as constant lines at /NAME/limits."""

    def static(self) -> Iterator[tuple[str, Any]]:
        """Names and colours."""
        channel = self.channel
        colours = channel.colours or palette(channel.shape[0])
        yield self.entity, lines(channel.names, colours)
        if channel.limits:
            of = [
                lighter(colours[channel.names.index(label)])
                for label in channel.limits
                for _ in range(2)
            ]
            yield f"{self.entity}/limits", lines(limits(channel), of, width=1.5)

    def columns(
        self,
        values: FloatArray,
        bodies: FloatArray,  # noqa: ARG002
        begins: IntArray,  # noqa: ARG002
    ) -> Iterator[Columns]:
        """Values, and limits."""
        yield Columns(self.entity, scalars(values))
        if self.channel.limits:
            ends = np.array([each for pair in self.channel.limits.values() for each in pair])
            yield Columns(f"{self.entity}/limits", scalars(np.tile(ends, (len(values), 1))))

    def curves(self) -> Mapping[str, int]:
        """Values, and limits."""
        both = {
            self.entity: self.channel.shape[0],
            f"{self.entity}/limits": 2 * len(self.channel.limits),
        }
        return {entity: count for entity, count in both.items() if count}

    @classmethod
    def panels(cls, channel: Channel, *, alone: bool) -> Sequence[Panel]:  # noqa: ARG003
        """Panel with one plot."""
        return (
            Panel(
                "curves",
                path(channel.name),
                title(channel),
                [*channel.names, *limits(channel)],
            ),
        )


class Flags(ChannelDrawing):
    """State lanes at /NAME/LABEL."""

    def static(self) -> Iterator[tuple[str, Any]]:
        """Names and colours."""
        colours = self.channel.colours or palette(self.channel.shape[0])
        for entity, colour in zip(entities(self.channel), colours, strict=True):
            yield entity, rr.StateConfiguration(values=STATES, colors=[_OFF, colour])

    def columns(
        self,
        values: FloatArray,
        bodies: FloatArray,  # noqa: ARG002
        begins: IntArray,
    ) -> Iterator[Columns]:
        """Changes, and where a rollout begins."""
        for entity, flags in zip(entities(self.channel), (values > 0).T, strict=True):
            rows = changes(2 * begins + flags)
            yield Columns(
                entity,
                rr.StateChange.columns(state=[STATES[int(flags[row])] for row in rows]),
                rows,
            )

    @classmethod
    def panels(cls, channel: Channel, *, alone: bool) -> Sequence[Panel]:  # noqa: ARG003
        """Panel with all lanes."""
        return (Panel("lanes", path(channel.name), title(channel)),)


class Images(ChannelDrawing):
    """Pictures at /NAME/LABEL; with places also points on their bodies, at /world/BODY/NAME."""

    def __init__(self, channel: Channel, scene: Scene, within: SceneEntities) -> None:
        super().__init__(channel, scene, within)
        self._on = [] if channel.places is None else _on_bodies(channel, self.on)

    def static(self) -> Iterator[tuple[str, Any]]:
        """Sizes and colours, and places."""
        channel = self.channel
        _, height, width = channel.shape
        size = rr.components.ImageFormat(width=width, height=height, channel_datatype="F32")
        style = rr.DepthImage.from_fields(format=size, depth_range=(0.0, channel.top), **_STYLE)
        for entity in entities(channel):
            yield entity, style
            yield from scale(entity, width, height, channel.top, channel.unit)
        for entity, places in zip(
            self._on, () if channel.places is None else channel.places, strict=True
        ):
            yield entity, rr.Points3D.from_fields(positions=places, radii=POINT_RADIUS * self.size)

    def columns(
        self,
        values: FloatArray,
        bodies: FloatArray,  # noqa: ARG002
        begins: IntArray,  # noqa: ARG002
    ) -> Iterator[Columns]:
        """Pixels, in pictures and on bodies."""
        for entity, image in zip(entities(self.channel), np.moveaxis(values, 1, 0), strict=True):
            pixels = np.ascontiguousarray(image.reshape(len(image), -1), dtype=np.float32)
            yield Columns(entity, rr.DepthImage.columns(buffer=pixels.view(np.uint8)))
        for i, entity in enumerate(self._on):
            pixels = values[:, i].reshape(len(values), -1)
            colours = rr.Points3D.columns(colors=ramp(pixels.reshape(-1), self.channel.top))
            yield Columns(entity, colours.partition(np.full(len(pixels), pixels.shape[1])))

    @classmethod
    def panels(cls, channel: Channel, *, alone: bool) -> Sequence[Panel]:
        """Panels, one per image; with several channels of images the names are CHANNEL LABEL."""
        before = "" if alone and channel.labels else f"{title(channel)} "
        names = (before + label for label in channel.names)
        pairs = zip(entities(channel), names, strict=True)
        return [Panel("picture", entity, name[:1].upper() + name[1:]) for entity, name in pairs]


class Arrows(ChannelDrawing):
    """Arrows at /world/NAME."""

    def columns(
        self,
        values: FloatArray,
        bodies: FloatArray,
        begins: IntArray,  # noqa: ARG002
    ) -> Iterator[Columns]:
        """Arrows whose length is not 0."""
        origins, vectors = self.arrows(values, bodies)
        visible = (vectors != 0).any(axis=-1)
        colours = [pack(colour) for colour in self.channel.colours or [_ARROW] * values.shape[1]]
        columns = rr.Arrows3D.columns(
            origins=origins[visible],
            vectors=vectors[visible],
            colors=np.broadcast_to(np.array(colours, np.uint32), visible.shape)[visible],
            radii=np.full(int(visible.sum()), ARROW_RADIUS * self.size),
        )
        yield Columns(f"/world{self.entity}", columns.partition(visible.sum(axis=1)))

    def arrows(self, values: FloatArray, bodies: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Origins [m] and vectors [m] of arrows in the world, (F, n, 3) each.

        Args:
          values: (F, n, 6) starts [m] and vectors [unit] in the frames of the channel's bodies.
          bodies: (F, B, 7) poses of the drawn bodies [m], quaternions wxyz.
        """
        vectors = self.channel.vectors(values)
        if self.bodies:
            vectors = rotate(bodies[:, self.bodies, 3:], vectors)
        return self.in_world(values[..., :3], bodies), vectors


class Points(ChannelDrawing):
    """Points at /world/NAME."""

    def columns(
        self,
        values: FloatArray,
        bodies: FloatArray,
        begins: IntArray,  # noqa: ARG002
    ) -> Iterator[Columns]:
        """Positions, and values as colours."""
        frames, count, _ = values.shape
        columns = rr.Points3D.columns(
            positions=self.in_world(values[..., :3], bodies).reshape(-1, 3),
            colors=ramp(values[..., 3].reshape(-1), self.channel.top),
            radii=np.full(frames * count, 2 * POINT_RADIUS * self.size),
        )
        yield Columns(f"/world{self.entity}", columns.partition(np.full(frames, count)))


KINDS: Final[Mapping[str, type[ChannelDrawing]]] = {
    "scalars": Scalars,
    "flags": Flags,
    "images": Images,
    "arrows": Arrows,
    "points": Points,
}
"""What draws each kind of channel."""


def panels(channels: Sequence[Channel], kind: str) -> list[Panel]:
    """The panels of this kind of some channels."""
    kinds = [channel.kind for channel in channels]
    each = (KINDS[one.kind].panels(one, alone=kinds.count(one.kind) == 1) for one in channels)
    return [panel for group in each for panel in group if panel.kind == kind]


def entities(channel: Channel) -> list[str]:
    """Paths of the channel's parts, by their labels."""
    return [f"{path(channel.name)}{path(label)}" for label in channel.names]


def limits(channel: Channel) -> list[str]:
    """Legend entries for the channel's limits, the smallest and the largest of each label."""
    return [
        f"{label}, {what} {value:g} {channel.unit}".strip()
        for label, pair in channel.limits.items()
        for what, value in zip(("least", "most"), pair, strict=True)
    ]


def _on_bodies(channel: Channel, bodies: list[str]) -> list[str]:
    """Paths of the images' pixels as points: on their bodies, by label where several are on one."""
    if not bodies:
        return [f"/world{entity}" for entity in entities(channel)]
    labels = [
        "" if bodies.count(body) == 1 else path(label)
        for body, label in zip(bodies, channel.names, strict=True)
    ]
    return [
        f"{body}{path(channel.name)}{label}" for body, label in zip(bodies, labels, strict=True)
    ]


def title(channel: Channel) -> str:
    """Name of the channel's view, with its unit."""
    name = " ".join(channel.name.replace("_", " ").split("/"))
    return f"{name[:1].upper()}{name[1:]}" + (f" [{channel.unit}]" if channel.unit else "")


def pictures(traces: Sequence[AnyArray]) -> rr.ComponentColumnList:
    """Traces (T, K) of rollouts as pictures of K rows and T columns, one after another."""
    pixels = [np.ascontiguousarray(values.T, dtype=np.float32).reshape(-1) for values in traces]
    return rr.DepthImage.columns(buffer=np.stack(pixels).view(np.uint8))


def scale(entity: str, width: int, height: int, top: float, unit: str) -> Iterator[tuple[str, Any]]:
    """A bar of a picture's colours to its right, from 0 to `top` [unit].

    The picture has width x height pixels.
    """
    x, thick = width + 0.12 * height, 0.02 * height
    ends = np.linspace(height, 0.0, _SHADES + 1)
    steps = [[(x, lower), (x, upper)] for lower, upper in pairwise(ends.tolist())]
    shades = ramp(np.linspace(0.0, top, _SHADES), top)
    yield f"{entity}/scale", rr.LineStrips2D(steps, colors=shades, radii=thick)
    texts = [f"{top:g} {unit}".strip(), "0"]
    yield (
        f"{entity}/scale/ends",
        labels([(x + 0.2 * height, 0.0), (x + 0.2 * height, 0.95 * height)], texts),
    )


def labels(places: Sequence[tuple[float, float]], texts: Sequence[str]) -> rr.Points2D:
    """Texts at places in a picture [pixels]."""
    return rr.Points2D(
        places, labels=texts, radii=0.0, colors=[_TEXT] * len(texts), show_labels=True
    )


def axes(entity: str, spec: TaskSpec) -> Iterator[tuple[str, Any]]:
    """Style and labels of a trace's pictures: names of their rows, their duration, and their
    colours.
    """
    steps, rows = spec.trace_shape
    size = rr.components.ImageFormat(width=steps, height=rows, channel_datatype="F32")
    yield (
        entity,
        rr.DepthImage.from_fields(
            format=size, depth_range=(0.0, spec.trace_channels[0].top), **_STYLE
        ),
    )
    first, places, texts = 0, [], []
    for channel in spec.trace_channels:
        each = int(np.prod(channel.shape[1:]))
        for i, name in enumerate(channel.names if each > 1 else [title(channel)]):
            count = each if each > 1 else channel.shape[0]
            places.append((-0.35 * rows, first + (i + 0.5) * count))
            texts.append(name)
        first += int(np.prod(channel.shape))
    places += [(0.0, 1.06 * rows), (float(steps), 1.06 * rows)]
    texts += ["0", f"{steps * spec.period:g} s"]
    yield f"{entity}/axes", labels(places, texts)
    yield from scale(entity, steps, rows, spec.trace_channels[0].top, spec.trace_channels[0].unit)


def changes(states: AnyArray) -> IntArray:
    """The first row, and those that differ from the row before, (F,) -> (n,)."""
    return np.flatnonzero(np.append(True, states[1:] != states[:-1]))


_STYLE: Final = {
    "colormap": rr.components.Colormap.Viridis,
    "magnification_filter": rr.components.MagnificationFilter.Nearest,
}
