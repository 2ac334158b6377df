"""How a recording shows a task's channels and primitives."""

from dataclasses import replace
from typing import get_args

import mujoco
import numpy as np
import pytest
from made import report, stats
from rerun.chunk import RrdReader
from robot import robot

from farm.errors import ConfigError
from farm.sim.channels import Kind
from farm.sim.framing import View
from farm.sim.model_files import compiled
from farm.sim.scene import MODEL, Geometry, Scene
from farm.sim.trajectory import Trajectory, joined
from farm.tasks.base import Camera, Channel, TaskSpec
from learner.recording.channels import KINDS, Arrows, changes, title
from learner.recording.curves import ramp
from learner.recording.drawing import Drawing
from learner.recording.entities import SceneEntities
from learner.recording.eye import Eye
from learner.recording.solids import ENDLESS, rotate, solid
from learner.run.config import configure
from learner.run.setup import start as begin


@pytest.fixture
def written(start, rollout, rows_of):
    trajectory = rollout(7)  # it ended early
    recorder = start()
    recorder.generation(report(stats(), trajectory))
    recorder.close()
    return trajectory, rows_of()


def test_curves_hold_what_the_rollout_held(written):
    trajectory, rows = written
    np.testing.assert_array_equal(rows.column("/reward/terms", "scalars"), trajectory.terms)
    np.testing.assert_array_equal(rows.column("/actions", "scalars"), trajectory.actions)
    np.testing.assert_array_equal(
        rows.column("/touch/force", "scalars"), trajectory.channels["touch/force"]
    )
    assert rows.fixed("/touch/force", "names") == ["left", "right side"]
    assert rows.fixed("/reward/terms", "names") == ["reach", "cost"]
    assert rows.fixed("/actions", "names") == ["1", "2"]


def test_limits_are_constant_lines_beside_their_curve(written):
    trajectory, rows = written
    assert rows.column("/touch/force/limits", "scalars") == [[0.25, 1.5]] * 7
    assert rows.times("/touch/force/limits") == rows.times("/touch/force")
    assert rows.fixed("/touch/force/limits", "names") == [
        "right side, least 0.25 N",
        "right side, most 1.5 N",
    ]
    shade = 0xF2CF7FFF  # between that of "right side" and white
    assert rows.fixed("/touch/force/limits", "colors") == [shade, shade]
    assert rows.fixed("/touch/force/limits", "widths") < rows.fixed("/touch/force", "widths")


@pytest.mark.parametrize(
    "wrong",
    [
        {"limits": {"c": (0.0, 1.0)}},
        {"limits": {"a": (1.0, 0.0)}},
        {"kind": "flags", "limits": {"a": (0, 1)}},
        {"limits": {"a": ("0", "1")}},
        {"limits": {"a": (0, 1, 2)}},
        {"limits": {"a": (0, float("inf"))}},
    ],
)
def test_limits_without_a_curve_or_a_range_are_refused(wrong):
    with pytest.raises(
        ConfigError,
        match=r"channel x: limits \(.*\) of '[ac]'; expected two rising finite numbers for scalars",
    ):
        Channel(**{"name": "x", "kind": "scalars", "shape": (2,), "labels": ("a", "b"), **wrong})


def test_bodies_are_where_they_were(written, scene):
    trajectory, rows = written
    poses = trajectory.bodies[:, scene.bodies.index("arm")]
    np.testing.assert_allclose(
        np.array(rows.column("/world/arm", "quaternion"))[:, 0], poses[:, [4, 5, 6, 3]], atol=1e-6
    )
    np.testing.assert_allclose(
        np.array(rows.column("/world/arm", "translation"))[:, 0], poses[:, :3], atol=1e-6
    )
    assert {"/config", "/world/world", "/world/world/floor", "/world/arm/arm"} <= rows.static


def test_flags_are_recorded_where_they_change(written):
    _, rows = written
    assert rows.column("/touch/state/left", "state") == [["off"], ["on"]]
    assert rows.times("/touch/state/right\\ side") == [0, 300_000_000]


def test_images_are_pictures_and_points_on_their_bodies(written):
    trajectory, rows = written
    images = trajectory.channels["pads"]
    pixels = np.array(rows.column("/pads/right\\ side", "buffer"), dtype=np.uint8)[:, 0]
    np.testing.assert_array_equal(
        np.ascontiguousarray(pixels).view(np.float32), images[:, 1].reshape(7, -1).astype("f4")
    )
    colours = np.array(rows.column("/world/arm/pads", "colors"))
    np.testing.assert_array_equal(colours, ramp(images[:, 1].reshape(7, -1), 2.0))
    places = np.array(rows.fixed("/world/ball/pads", "positions"))
    np.testing.assert_allclose(places, np.arange(18.0).reshape(6, 3) / 100, atol=1e-6)


def test_arrows_stand_on_their_bodies(written, scene):
    trajectory, rows = written
    values, vectors = trajectory.channels["touch/push"], rows.column("/world/touch/push", "vectors")
    assert [len(arrows) for arrows in vectors] == [
        0,
        0,
        0,
        2,
        2,
        2,
        2,
    ], "arrows of zero length are not drawn"
    origins = rows.column("/world/touch/push", "origins")
    for frame in range(3, 7):
        for i, body in enumerate(("ball", "arm")):
            pose = trajectory.bodies[frame, scene.bodies.index(body)]
            place = np.zeros(3)
            vector = np.zeros(3)
            mujoco.mju_rotVecQuat(place, values[frame, i, :3], pose[3:])
            mujoco.mju_rotVecQuat(vector, 0.5 * values[frame, i, 3:], pose[3:])
            np.testing.assert_allclose(origins[frame][i], pose[:3] + place, atol=1e-6)
            np.testing.assert_allclose(vectors[frame][i], vector, atol=1e-6)


def test_the_actions_curves_have_the_tasks_names(tmp_path):
    task = robot(tmp_path / "mine")
    problem, _ = begin(configure(f"{task}:Reach", policy="linear"), "r")
    entities = dict(Drawing.of(problem).static())
    assert entities["/actions"].names.as_arrow_array().to_pylist() == ["hinge"]


def test_long_arrows_are_cut(scene):
    channel = Channel(name="a", kind="arrows", shape=(1, 6), length=2.0, longest=0.5)
    drawing = Arrows(channel, scene, SceneEntities(scene, [channel]))
    _, vectors = drawing.arrows(np.array([[[0, 0, 0, 3.0, 0, 4.0]]]), np.zeros((1, 3, 7)))
    np.testing.assert_allclose(vectors, [[[0.3, 0.0, 0.4]]])


def test_points_are_coloured_by_value(written):
    trajectory, rows = written
    values = trajectory.channels["goals"]
    np.testing.assert_allclose(rows.column("/world/goals", "positions"), values[..., :3], atol=1e-6)
    np.testing.assert_array_equal(rows.column("/world/goals", "colors"), ramp(values[..., 3], 4.0))


def test_a_task_without_channels_has_bodies_actions_and_reward(start, rollout, rows_of, plain):
    recorder = start(spec=plain)
    unknown = {"mean_policy_success": None, "success_rate": None}
    recorder.generation(report(stats(**unknown), rollout(spec=plain)))
    recorder.close()
    rows = rows_of()
    moving = {
        "/world/ball",
        "/world/arm",
        "/world/caption",
        "/world/view",
        "/reward/terms",
        "/actions",
    }
    assert {entity for entity in rows.batches if len(rows.times(entity)) == 16} == moving
    assert "/learning/success" not in rows.batches


def test_the_layout_travels_in_the_file(start, tmp_path):
    start().close()
    reader = RrdReader(tmp_path / "run.rrd")
    assert len(reader.blueprints()) == 1
    assert [(r.recording_id, r.application_id) for r in reader.recordings()] == [
        ("try", "rolloutfarm")
    ]


def test_the_eye_is_the_cameras_or_beside_what_moves(scene):
    eye = Eye.of(View(scene, Camera(lookat=(1, 2, 3), distance=2.0, azimuth=90.0, elevation=-30.0)))
    assert (eye.target.tolist(), eye.tracked) == ([1, 2, 3], None)
    np.testing.assert_allclose(
        eye.away / np.linalg.norm(eye.away), [0, -np.cos(np.pi / 6), 0.5], atol=1e-12
    )
    assert Eye.of(View(scene, None)).tracked == "/world/view"
    still = Scene(
        compiled(
            '<mujoco><worldbody><geom type="plane" size="4 4 1"/></worldbody></mujoco>', "still"
        )
    )
    assert Eye.of(View(still, None)).tracked is None


def test_another_tasks_rollout_is_refused(scene, spec, plain, rollout):
    good, drawing = rollout(), Drawing(scene, spec)
    for wrong, name in (
        (replace(good, bodies=good.bodies[:, 1:]), "bodies"),
        (replace(good, terms=good.terms[:, 1:]), "terms"),
        (
            replace(good, channels={**good.channels, "goals": good.channels["goals"][:, 1:]}),
            "channels/goals",
        ),
        (rollout(spec=plain), "actions"),
    ):
        with pytest.raises(ValueError, match=f"{name} of shape .* another scene or task"):
            list(drawing.columns(wrong))


def test_a_channel_on_an_unknown_body_is_refused(scene):
    channel = Channel(name="a", kind="arrows", shape=(1, 6), bodies=("leg",))
    spec = TaskSpec(observation=1, action=1, steps=1, period=1.0, channels=(channel,))
    with pytest.raises(ConfigError, match="no body 'leg' .* known are world, ball, arm"):
        Drawing(scene, spec)


def test_titles_say_the_unit():
    assert (
        title(Channel(name="touch/contact_force", kind="scalars", shape=(1,), unit="N"))
        == "Touch contact force [N]"
    )
    assert title(Channel(name="x", kind="scalars", shape=(1,))) == "X"


def test_a_capsule_starts_where_its_axis_begins(scene):
    capsule = solid(next(g for g in scene.geometries() if g.name == "arm"))
    start = np.array(capsule.translations.as_arrow_array().to_pylist()[0])
    [turn] = capsule.quaternions.as_arrow_array().to_pylist()
    [length] = capsule.lengths.as_arrow_array().to_pylist()
    end = start + rotate(np.roll(turn, 1), np.array([0.0, 0.0, length]))
    np.testing.assert_allclose(sorted([start[2], end[2]]), [0.1, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("size", "sides"), [((2.0, 3.0, 0.1), [2.0, 3.0]), ((0.0, 3.0, 0.1), [ENDLESS, 3.0])]
)
def test_a_plane_is_a_thin_box_with_its_top_where_the_plane_is(size, sides):
    half = np.sqrt(0.5)  # turned by 90 degrees about x: its normal is -y
    plane = Geometry(
        "floor",
        "world",
        "plane",
        size,
        (1.0, 2.0, 3.0),
        (half, half, 0.0, 0.0),
        (0.5, 0.5, 0.5, 1.0),
    )
    box = solid(plane)
    [extent], [centre] = (
        part.as_arrow_array().to_pylist() for part in (box.half_sizes, box.centers)
    )
    np.testing.assert_allclose(extent, [*sides, 0.001], atol=1e-9)
    np.testing.assert_allclose(centre, [1.0, 2.001, 3.0], atol=1e-6)


def test_an_ellipsoid_has_three_radii():
    shape = Geometry(
        "e", "b", "ellipsoid", (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), (1.0, 0, 0, 0), (1.0, 0, 0, 1.0)
    )
    np.testing.assert_allclose(
        solid(shape).half_sizes.as_arrow_array().to_pylist(), [[0.1, 0.2, 0.3]], rtol=1e-6
    )


def test_a_mesh_is_turned_and_placed_with_normals_that_look_outwards():
    half = np.sqrt(0.5)  # turned by 90 degrees about z: x becomes y
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    place, turn, colour = (1.0, 2.0, 3.0), (half, 0.0, 0.0, half), (0.2, 0.4, 0.6, 1.0)
    mesh = solid(Geometry("m", "b", "mesh", (1.0, 1.0, 1.0), place, turn, colour, corners, faces))
    vertices = np.array(mesh.vertex_positions.as_arrow_array().to_pylist())
    np.testing.assert_allclose(vertices, [[1, 2, 3], [1, 3, 3], [0, 2, 3], [1, 2, 4]], atol=1e-6)
    normals = np.array(mesh.vertex_normals.as_arrow_array().to_pylist())
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    assert (np.sum(normals * (vertices - vertices.mean(axis=0)), axis=1) > 0).all()
    assert mesh.triangle_indices.as_arrow_array().to_pylist() == faces.tolist()


def test_colours_run_from_violet_to_yellow():
    assert [hex(c) for c in ramp(np.array([-1.0, 0.0, 2.0, 9.0]), 2.0)] == ["0x440154ff"] * 2 + [
        "0xfde725ff"
    ] * 2


def test_changes_are_the_first_row_and_every_other_state():
    assert changes(np.array([False, False, True, True, False])).tolist() == [0, 2, 4]
    assert changes(np.array([True])).tolist() == [0]


def test_a_rollout_shows_the_geometries_of_its_own_model_only():
    """Those that all models have stay as they are; a scale of 0 hides the others."""
    body = (
        '<mujoco model="{0}"><worldbody>{1}<body'
        ' name="ball"><freejoint/>{2}</body></worldbody></mujoco>'
    )
    floor, ball = '<geom name="floor" type="plane" size="4 4 1"/>', '<geom name="ball" size="{}"/>'
    texts = [
        body.format(name, floor, ball.format(size)) for name, size in (("small", 0.1), ("big", 0.2))
    ]
    channel = Channel(name=MODEL, kind="flags", shape=(2,), labels=("small", "big"))
    spec = TaskSpec(observation=1, action=1, steps=1, period=1.0, channels=(channel,))
    scene = Scene.of([compiled(text, "one of two") for text in texts])
    drawing = Drawing(scene, spec)
    solids = dict(drawing.static())
    assert {"/world/world/floor", "/world/ball/ball-0", "/world/ball/ball-1"} <= solids.keys()
    assert solids["/world/ball/ball-1"].half_sizes.as_arrow_array().to_pylist() == [
        pytest.approx([0.2] * 3)
    ]
    rollouts = [
        Trajectory.of(
            times=np.arange(2.0),
            bodies=np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, len(scene.bodies), 1)),
            actions=np.zeros((2, 1)),
            terms=np.zeros((2, 1)),
            channels=scene.said(which, 2),
            value=0.0,
            success=None,
        )
        for which in (1, 0)
    ]
    parts = {part.entity: part.columns for part in drawing.columns(joined(rollouts))}
    assert "/world/world/floor" not in parts
    for which, scales in ((0, [0.0, 0.0, 1.0, 1.0]), (1, [1.0, 1.0, 0.0, 0.0])):
        [column] = [
            each
            for each in parts[f"/world/ball/ball-{which}"]
            if "scale" in str(each.component_descriptor())
        ]
        assert (
            np.ravel(column.as_arrow_array().to_pylist()).tolist() == np.repeat(scales, 3).tolist()
        )


def test_every_kind_of_channel_is_drawn() -> None:
    assert KINDS.keys() == set(get_args(Kind))
