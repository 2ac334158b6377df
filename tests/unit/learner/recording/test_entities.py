"""Each body and geometry of a scene has an entity of its own, whatever the alphabet of its name."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from farm.sim.channels import Channel
from farm.sim.model_files import compiled
from farm.sim.scene import Scene, distinct
from farm.sim.trajectory import Trajectory
from farm.tasks.base import TaskSpec
from learner.recording.drawing import Drawing
from learner.recording.entities import SceneEntities
from learner.recording.replay import record_replay

NAMES = (
    *(
        "left arm",
        "left_arm",
        "left-arm",
        "left.arm",
        "left/arm",
        "left\\arm",
        "left:arm",
        "arm#1",
        "arm@1",
        "arm 1",
    ),
    *(
        "bras gauche é",
        "bras gauche è",
        "左腕",
        "右腕",
        "плечо",
        "локоть",
        "ذراع",
        "\U0001f9be",
        "\U0001f9bf",
        "__arm",
        "0",
        "-1",
    ),
    *(
        "caption",
        "view",
        "force",
        "body_30",
        "body_31",
        "geom_1",
        "touch",
        "x" * 200,
        "e\u0301",
        "\u00e9",
    ),
)


def bodies(names: tuple[str, ...]) -> str:
    def escaped(name: str) -> str:
        return name.replace("&", "&amp;").replace('"', "&quot;")

    moving = "".join(
        f'<body name="{escaped(name)}" pos="{i} 0 0"><joint axis="0 0 1"/><geom'
        f' name="{escaped(name)}" size=".1"/><geom size=".2" pos="0 .5 0"/></body>'
        for i, name in enumerate(names)
    )
    return (
        f'<mujoco><worldbody>{moving}<body pos="0 1 0"><geom size="1"/></body></worldbody></mujoco>'
    )


CHANNELS = (
    Channel(name="force", kind="arrows", shape=(1, 6), bodies=("左腕",), length=0.1),
    Channel(
        name="touch",
        kind="images",
        shape=(2, 1, 1),
        top=1.0,
        bodies=("左腕", "右腕"),
        places=np.zeros((2, 1, 3)),
    ),
)


def test_no_two_share_an_entity() -> None:
    scene = Scene(compiled(bodies(NAMES), "m"))
    drawing = SceneEntities(scene, CHANNELS)
    assert len(scene.bodies) == len(set(scene.bodies)) == len(NAMES) + 1
    assert scene.bodies[:-1] == NAMES
    paths = [*drawing.bodies, *(entity for entity, _ in drawing.geometries)]
    others = [
        "/world/caption",
        "/world/view",
        "/world/force",
        f"{drawing.bodies[NAMES.index('左腕')]}/touch",
    ]
    assert len({*paths, *others}) == len(paths) + len(others) == 3 * len(NAMES) + 2 + 4
    for name, path in zip(NAMES, drawing.bodies, strict=False):
        assert path == f"/world/{rr.escape_entity_path_part(name)}" or name in (
            "caption",
            "view",
            "force",
            "touch",
        )
        assert scene.index(name) == NAMES.index(name)
        assert scene.number(name) == scene.model.body(name).id
    assert scene.number(scene.bodies[-1]) == scene.model.nbody - 1, "it has no name in the model"


def test_a_recording_has_them_all(tmp_path: Path) -> None:
    """Read back: every body moves on its own entity."""
    scene = Scene(compiled(bodies(NAMES), "m"))
    spec = TaskSpec(observation=1, action=1, steps=3, period=0.1, channels=CHANNELS[:1])
    poses = np.zeros((4, len(scene.bodies), 7), "<f4")
    poses[..., 0], poses[..., 3] = np.arange(len(scene.bodies)), 1.0
    rollout = Trajectory(
        times=np.arange(4) * 0.1,
        bodies=poses,
        actions=np.zeros((4, 1), "<f4"),
        terms=np.zeros((4, 1), "<f4"),
        channels={"force": np.zeros((4, 1, 6), "<f4")},
        value=0.0,
        success=None,
    )
    path = tmp_path / "r.rrd"
    record_replay(
        path, run="try", drawing=Drawing(scene, spec), config="", rollouts=[("one", rollout)]
    )
    found: dict[str, float] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        column = next(
            (name for name in batch.schema.names if name.endswith("Transform3D:translation")), None
        )
        if column is not None:
            found[chunk.entity_path] = batch.column(column)[-1].as_py()[0][0]
    moving = dict(
        zip(SceneEntities(scene, CHANNELS[:1]).bodies, range(len(scene.bodies)), strict=True)
    )
    assert {path: found.get(path) for path in list(moving)[:-1]} == {
        path: x for path, x in list(moving.items())[:-1]
    }


@pytest.mark.parametrize(
    ("names", "taken", "expected"),
    [
        (["a", "b"], set(), ["a", "b"]),
        (["a", "a", "a"], set(), ["a", "a_", "a__"]),
        (["a", "a_"], {"a"}, ["a__", "a_"]),
        (["a_", "a"], {"a", "a_"}, ["a__", "a___"]),
        ([], {"a"}, []),
    ],
)
def test_names_become_distinct(names: list[str], taken: set[str], expected: list[str]) -> None:
    assert distinct(names, taken) == expected
