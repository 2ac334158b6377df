"""Valid and invalid channels."""

import pytest

from farm.errors import ConfigError
from farm.sim.channels import Channel
from farm.tasks.base import TaskSpec

GOOD = {"scalars": (3,), "flags": (1,), "images": (2, 3, 4), "arrows": (2, 6), "points": (5, 4)}


@pytest.mark.parametrize("kind", GOOD)
def test_names_of_what_is_shown(kind):
    channel = Channel(name="a/b", kind=kind, shape=GOOD[kind])
    assert channel.names == tuple(str(i + 1) for i in range(GOOD[kind][0]))
    labels = tuple("abcde"[: GOOD[kind][0]])
    assert Channel(name="a/b", kind=kind, shape=GOOD[kind], labels=labels).names == labels


@pytest.mark.parametrize(
    ("kind", "shape", "words"),
    [
        ("curves", (3,), r"channel c: kind 'curves' of shape \(3,\); see Channel\.kind"),
        *((kind, (*shape, 1), f"kind '{kind}' of shape") for kind, shape in GOOD.items()),
        ("scalars", (), "kind 'scalars' of shape"),
        ("scalars", (0,), r"scalars of shape \(0,\)"),
        ("images", (2, 0, 4), "images of shape"),
        ("arrows", (2, 3), r"arrows of shape \(2, 3\); expected \(n, 6\)"),
        ("points", (2, 3), r"points of shape \(2, 3\); expected \(n, 4\)"),
    ],
)
def test_shapes_that_make_no_sense(kind, shape, words):
    with pytest.raises(ConfigError, match=words):
        Channel(name="c", kind=kind, shape=shape)


@pytest.mark.parametrize("what", ["labels", "colours", "bodies", "geoms"])
def test_one_each_or_none(what):
    one = (255, 0, 0) if what == "colours" else "x"
    for count in (0, 2):
        Channel(name="c", kind="points", shape=(2, 4), **{what: (one,) * count})
    with pytest.raises(ConfigError, match=f"channel c: 3 {what} for 2"):
        Channel(name="c", kind="points", shape=(2, 4), **{what: (one,) * 3})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"name": 3}, "channel 3: its name must be a text"),
        ({"name": ""}, "channel '': its name must be a text"),
        ({"shape": 1}, r"channel c: shape is 1; expected a tuple of whole numbers, as \(3,\)"),
        ({"shape": (1.0,)}, r"channel c: shape is \(1.0,\)"),
        ({"labels": "x"}, "channel c: labels is 'x'; expected a tuple of texts"),
        ({"bodies": (3,)}, r"channel c: bodies is \(3,\)"),
        ({"colours": ("red",)}, "channel c: colour 'red'; expected red, green, blue from 0 to 255"),
        ({"colours": ((0, 0, 256),)}, r"channel c: colour \(0, 0, 256\)"),
    ],
)
def test_values_of_other_types(values, words):
    with pytest.raises(ConfigError, match=words):
        Channel(**{"name": "c", "kind": "scalars", "shape": (1,), **values})


def test_what_travels_of_them():
    channels = (
        Channel(name="force", kind="images", shape=(2, 3, 4), trace=True),
        Channel(name="shown", kind="points", shape=(2, 4)),
        Channel(name="angle", kind="scalars", shape=(5,), trace=True),
    )
    spec = TaskSpec(
        observation=1, action=2, steps=7, period=0.1, terms=("a", "b"), channels=channels
    )
    assert [channel.name for channel in spec.trace_channels] == ["force", "angle"]
    assert spec.trace_shape == (7, 29)
    assert spec.shapes(9) == {
        "bodies": (9, 7),
        "actions": (2,),
        "terms": (2,),
        "channels/force": (2, 3, 4),
        "channels/shown": (2, 4),
        "channels/angle": (5,),
    }
    assert TaskSpec(observation=1, action=1, steps=7, period=0.1).trace_shape == (7, 0)
