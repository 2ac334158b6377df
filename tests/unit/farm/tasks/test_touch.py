"""Touch by MuJoCo's own sensors: what they read, how late and how noisily, and how it is shown."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

import farm
from farm.__main__ import main
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.loop import Batch, again

PADS = {"near": ("a", "b"), "far": ("c", "d")}
XML = """<mujoco>
  <option timestep="0.002"/>
  <asset><mesh name="skin" builtin="sphere" params="2" scale="0.1 0.1 0.1"/></asset>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="ball" pos="0.1 0 0.0999" quat="0 1 0 0">
      <joint name="z" type="slide" axis="0 0 -1"/>
      <geom name="ball" type="sphere" size="0.1" mass="2"/>
      <site name="a" pos="0 0 0.1" size="0.02"/>
      <site name="b" pos="0 0 -0.1" size="0.02"/>
    </body>
    <body name="box" pos="-0.3 0 0.05">
      <joint name="y" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size="0.05 0.05 0.05" mass="1"/>
      <site name="c" pos="0.05 0 -0.05" size="0.06"/>
      <site name="d" pos="-0.05 0 -0.05" size="0.06"/>
    </body>
  </worldbody>
  <actuator><motor joint="z" ctrlrange="-9 9"/></actuator>
  <sensor>
    <touch name="a" site="a"/>
    <touch name="b" site="b"/>
    <touch name="c" site="c"/>
    <touch name="d" site="d"/>
    <contact name="ball" geom1="ball" data="found force pos" num="2"/>
    <contact name="box" geom1="box" num="4" data="found force"/>
    <contact name="bare" geom1="box" data="force"/>
    <tactile name="skin" geom="ball" mesh="skin"/>
    <jointpos name="height" joint="z"/>
  </sensor>
</mujoco>"""


class Press(farm.Task):
    """A ball that a motor lifts and presses on the ground, and a box that stands there."""

    Config = farm.TouchConfig
    xml = XML
    steps, substeps = 40, 5
    pads: Any = PADS
    shape: Any = None

    @cached_property
    def touch(self) -> farm.Touch:
        return farm.Touch(
            self.model, self.pads, self.config, self.steps, shape=self.shape, top=30.0
        )

    def reset(self, sim: farm.Sim, row: int, rng: np.random.Generator | None) -> None:
        self.touch.reset(sim, row, rng)

    def observe(self, sim: farm.Sim) -> FloatArray:
        return self.touch.felt(sim)

    def measure(self, sim: farm.Sim) -> dict[str, FloatArray]:
        return {"touch": self.touch.true(sim)}

    def reward(self, sim: farm.Sim, action: FloatArray) -> FloatArray:
        return sim.qpos[:, 0]


class Force(Press):
    pads = {"ball": ("ball",), "box": ("box",)}


class Skin(Press):
    pads = {"ball": ("skin",)}
    shape = (9, 18)


def played(task: Press, seeds: list[tuple[int, ...] | None]) -> tuple[FloatArray, FloatArray]:
    """What was felt before each control step (T, B, n), and true at the start and after each (T +
    1, B, n).
    """
    sim = Sim(BatchEngine(task.model, len(seeds)))

    def play() -> tuple[FloatArray, FloatArray]:
        batch, felt = Batch(task, sim, seeds), []
        while not batch.over:
            felt.append(batch.observe().copy())
            batch.step(np.full((len(seeds), 1), np.sin(0.3 * batch.sim.t)))
        true = np.concatenate([batch.start["touch"][:, None], batch.frames["touch"]], axis=1)
        return np.stack(felt), np.moveaxis(true.reshape(*true.shape[:2], -1), 0, 1)

    return again(play)


def test_weights_are_felt_where_they_rest() -> None:
    felt, true = played(Press(), [None])
    assert felt.shape == (40, 1, 4)
    np.testing.assert_array_equal(
        felt[1:], true[1:40], err_msg="without settings it is the present reading"
    )
    up, down = true[20:, 0, 0], true[20:, 0, 1]
    expected = 2 * 9.81 - 9 * np.sin(0.3 * np.arange(19, 40))
    assert (down == 0.0).all(), "the site on the other side of the ball"
    np.testing.assert_allclose(up, expected, atol=0.5)
    np.testing.assert_allclose(true[20:, 0, 2:].sum(axis=1), 9.81, atol=1e-2)
    np.testing.assert_allclose(true[20:, 0, 2], true[20:, 0, 3], rtol=1e-3)


def test_a_contact_sensor_feels_the_same_force() -> None:
    _, by_site = played(Press(), [None])
    _, by_geom = played(Force(), [None])
    np.testing.assert_allclose(by_geom[1:, 0, 0], by_site[1:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(by_geom[20:, 0, 1], 9.81, atol=1e-2)


def test_a_meshs_vertices_feel_depth_in_their_bodys_frame() -> None:
    task = Skin()
    _, true = played(task, [None])
    last, places = true[-1, 0], task.touch.channel.places
    assert task.touch.channel.unit == "m"
    assert places is not None
    assert places.shape == (1, 162, 3)
    deepest = places[0, int(last.argmax())]
    np.testing.assert_allclose(
        deepest, [0.0, 0.0, 0.1], atol=1e-3, err_msg="the ball is upside down"
    )
    assert 0.0 < last.max() < 2e-3
    assert (last > 0).sum() < 20


@pytest.mark.parametrize(("delay", "interval"), [(0, 1), (3, 1), (0, 4), (2, 3), (50, 1)])
def test_delay_and_interval_are_in_control_steps(delay: int, interval: int) -> None:
    task = Press(farm.TouchConfig(touch_delay=delay, touch_interval=interval))
    felt, true = played(task, [None])
    steps = np.arange(40)
    at = np.maximum(0, steps // interval * interval - delay)
    np.testing.assert_array_equal(felt, true[at])
    assert (felt[-1] != felt[0]).any() == (delay < 40)


def test_noise_is_each_rollouts_own_and_part_of_the_reading() -> None:
    task = Press(farm.TouchConfig(touch_noise=0.5, touch_interval=2))
    seeds: list[tuple[int, ...] | None] = [(1, 2, 3, i) for i in range(30)]
    felt, true = played(task, [*seeds, None])
    samples = true[np.arange(40) // 2 * 2]
    noise = (felt - samples)[:, :-1]
    assert np.std(noise) == pytest.approx(0.5, rel=0.05)
    assert abs(noise.mean()) < 0.03
    np.testing.assert_array_equal(
        felt[0::2], felt[1::2], err_msg="a reading that holds has one noise"
    )
    np.testing.assert_array_equal(
        felt[:, -1], samples[:, -1], err_msg="none under nominal conditions"
    )
    alone, _ = played(task, [seeds[7]])
    np.testing.assert_array_equal(alone[:, 0], felt[:, 7], err_msg="whatever the batch")


def test_channel() -> None:
    channel = Press().touch.channel
    assert (channel.kind, channel.shape, channel.labels, channel.unit, channel.top) == (
        "images",
        (2, 1, 2),
        ("near", "far"),
        "N",
        30.0,
    )
    assert channel.bodies == ("ball", "box")
    assert channel.places is not None
    np.testing.assert_array_equal(channel.places[0], [[0, 0, 0.1], [0, 0, -0.1]])
    apart = farm.Touch(Press().model, {"one": ("a", "c")}, farm.TouchConfig(), 10).channel
    assert (apart.bodies, apart.places) == ((), None), "on two bodies: a picture only"


@pytest.mark.parametrize(
    ("pads", "shape", "line"),
    [
        ({"p": ("nobody",)}, None, "touch: there is no sensor 'nobody' in the model"),
        (
            {"p": ("height",)},
            None,
            (
                "touch: sensor 'height' is of kind jointpos; expected touch, contact, tactile or"
                " touch_grid"
            ),
        ),
        ({"p": ("bare",)}, None, "touch: contact sensor 'bare' needs data=\"found force\""),
        (
            {"p": ("a", "b"), "q": ("c",)},
            None,
            "touch: the pads' sensors give 2, 1 numbers; expected 1 x 2 for each",
        ),
        (
            {"p": ("a", "b")},
            (2, 2),
            "touch: the pads' sensors give 2 numbers; expected 2 x 2 for each",
        ),
        ({}, None, "touch: the pads' sensors give no numbers; expected 1 x 0 for each"),
        (
            {"p": ("a",) * 162, "q": ("skin",)},
            None,
            "touch: the sensors' units are N and m; expected one",
        ),
    ],
)
def test_what_cannot_be_felt_is_one_line(pads: Any, shape: Any, line: str) -> None:
    with pytest.raises(ConfigError) as error:
        farm.Touch(Press().model, pads, farm.TouchConfig(), 10, shape=shape)
    assert str(error.value) == line


GRIPPER = Path(__file__).parents[4] / "examples/tasks/gripper.py"


@pytest.mark.slow
def test_a_gripper_learns_to_lift_and_is_recorded_with_its_pads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sensing = ["--touch-noise", "0.05", "--touch-delay", "1", "--touch-interval", "2"]
    flags = ["--policy", "linear", "--normalise", "--algorithm", "ars", "--initial-sigma", "0.1"]
    flags += ["--learning-rate-mu", "0.1", "--pairs", "10", "--generations", "15"]
    assert (
        main(
            [
                "run",
                "--task",
                f"{GRIPPER}:Gripper",
                *sensing,
                *flags,
                "--workers",
                "1",
                "--name",
                "r",
            ]
        )
        == 0
    )
    policy = farm.load("runs/r")
    first, last = (farm.load("runs/r", generation=g).rollout().trajectory for g in (0, 15))
    assert last.value > first.value + 15.0
    pads = last.channels["touch"]
    assert pads.shape[1:] == (2, 3, 3)
    assert pads.sum(axis=(2, 3)).max() > 0.3, "both pads press"
    assert policy.problem.config.task_config.touch_delay == 1  # type: ignore[attr-defined]
    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "runs/r/run.rrd").stream()}
    for side in ("left", "right"):
        assert {f"/touch/{side}", f"/touch/{side}/scale", f"/world/{side}/touch"} <= entities
    capsys.readouterr()


def grid(
    size: str, *, channels: int = 1, field: str = "60 45", gamma: float = 0.0, ball: str = "0 0"
) -> str:
    """A pad that lies on a ball."""
    return f"""<mujoco>
      <extension>
        <plugin plugin="mujoco.sensor.touch_grid"/>
        <plugin plugin="mujoco.pid"/>
      </extension>
      <worldbody>
        <geom size=".01" pos="{ball} .01"/>
        <body name="pad" pos="0 0 .05">
          <joint name="z" type="slide" axis="0 0 1" damping="5"/>
          <geom type="box" size=".05 .05 .01" mass=".2"/>
          <site name="pad" pos="0 0 .02" size="0.03"/>
        </body>
      </worldbody>
      <actuator><motor joint="z" ctrlrange="-9 9"/></actuator>
      <sensor>
        <jointpos joint="z"/>
        <plugin name="grid" plugin="mujoco.sensor.touch_grid" objtype="site" objname="pad">
          <config key="size" value="{size}"/>
          <config key="fov" value="{field}"/>
          <config key="gamma" value="{gamma}"/>
          <config key="nchannel" value="{channels}"/>
        </plugin>
      </sensor>
    </mujoco>"""


@pytest.mark.parametrize("channels", [1, 3, 6])
@pytest.mark.parametrize(
    ("ball", "row", "column"), [("0 0", 1, 2), (".02 0", 1, 3), ("-.02 0", 1, 0), ("0 .02", 2, 2)]
)
def test_a_grid_is_a_picture_of_normal_forces(
    channels: int, ball: str, row: int, column: int
) -> None:
    ball = ball.replace("0 0", "0.001 0") if ball == "0 0" else ball.replace("0 .02", "0.001 .02")
    attributes = {
        "xml": grid("4 3", channels=channels, ball=ball),
        "pads": {"pad": ("grid",)},
        "steps": 100,
    }
    task = type("Own", (Press,), attributes)()
    assert task.touch.channel.shape == (1, 3, 4)
    assert (task.touch.channel.unit, task.touch.channel.bodies) == ("N", ("pad",))
    sim = Sim(BatchEngine(task.model, 1))

    def felt() -> FloatArray:
        batch = Batch(task, sim, [None])
        for _ in range(100):
            batch.observe()
            batch.step(np.full((1, 1), -0.1))
        return task.touch.true(sim)[0, 0]

    values = again(felt)
    expected = np.zeros((3, 4))
    expected[row, column] = 0.2 * 9.81 + 0.9
    np.testing.assert_allclose(values, expected, rtol=0.02)
    assert task.touch.channel.places is not None
    place = task.touch.channel.places[0].reshape(3, 4, 3)[row, column] - [0.0, 0.0, 0.02]
    felt_at = np.array([*map(float, ball.split()), -0.03])
    assert np.linalg.norm(place) == pytest.approx(0.03)
    cosine = place @ felt_at / np.linalg.norm(place) / np.linalg.norm(felt_at)
    assert cosine > np.cos(np.deg2rad(20.0)), "it is drawn where it is felt"


def test_several_grids_and_other_shapes() -> None:
    task = type(
        "Own",
        (Press,),
        {"xml": grid("4 3", gamma=0.5), "pads": {"pad": ("grid",)}, "shape": (4, 3)},
    )()
    assert task.touch.channel.shape == (1, 4, 3)
    twice = type("Own", (Press,), {"xml": grid("4 3"), "pads": {"pad": ("grid", "grid")}})()
    assert twice.touch.channel.shape == (1, 1, 24)
    plain = grid("4 3").replace('<config key="gamma" value="0.0"/>', "")
    without_gamma = type("Own", (Press,), {"xml": plain, "pads": {"pad": ("grid",)}})()
    assert without_gamma.touch.channel.shape == (1, 3, 4)
    two = type(
        "Own", (Press,), {"xml": grid("4 3"), "pads": {"left": ("grid",), "right": ("grid",)}}
    )()
    assert two.touch.channel.shape == (2, 3, 4)
