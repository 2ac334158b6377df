"""Several models in one batch: the bits of each alone, whatever the neighbours, and what is
refused.
"""

from typing import Any

import mujoco
import numpy as np
import pytest

from farm import Task
from farm.errors import ConfigError, TaskError
from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner
from farm.sim.engines import BatchEngine
from farm.sim.mixed import MixedEngine
from farm.sim.scene import MODEL, Scene
from farm.tasks.probe import specification
from farm.tasks.rollouts import Rollouts, whole

XML = """<mujoco model="{name}"><option timestep="0.01"/><worldbody>
  <geom name="floor" type="plane" size="2 2 0.1"/>
  <body name="pole" pos="0 0 {length}"><joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 {length}" size="0.02" mass="0.2"/>
    <geom name="tip" type="sphere" pos="0 0 {length}" size="0.05" mass="0.3"/>{extra}</body>
  </worldbody><actuator><motor joint="hinge" ctrlrange="-1.5 1.5"/></actuator></mujoco>"""
KNOB = (
    '<geom name="knob" type="box" pos="0.05 0 0.1" size="0.03 0.02 0.02" mass="0.1" friction="0.7'
    ' 0.01 0.001"/>'
)
TEXTS = [
    XML.format(name="long", length=0.5, extra=""),
    XML.format(name="short", length=0.3, extra=""),
    XML.format(name="knobbed", length=0.4, extra=KNOB),
]
SEEDS: list[tuple[int, ...] | None] = [(0,), (1,), None, (2,), (0,), (3,), (4,), (5,), (6,), (1,)]


class Rods(Task):
    """A rod of one of three kinds falls to the floor; with something of everything."""

    steps, substeps = 12, 5

    def models(self) -> list[Any]:
        """Texts and a compiled model."""
        return [*TEXTS[:2], mujoco.MjModel.from_xml_string(TEXTS[2])]

    def prepare(self, sim, rngs):
        """Perturb, and settle a little."""
        super().prepare(sim, rngs)
        sim.step(2)

    def reset(self, sim, row, rng):
        """Conditions of the rollout's own."""
        sim.qpos[row] = 0.2
        if rng is not None:
            sim.qpos[row] = rng.uniform(0.1, 2.0)
            sim.expand("body_mass")[row] *= rng.uniform(0.8, 1.2)
            sim.expand("geom_friction")[row] *= rng.uniform(0.5, 1.5)
            sim.expand("opt.gravity")[row] *= rng.uniform(0.9, 1.1)

    def observe(self, sim):
        """States, outputs, forces, a ray and a Jacobian."""
        dist, _ = sim.ray([0.0, 0.0, 3.0], [0.0, 0.0, -1.0])
        moves, _ = sim.jac("pole", sim.body("pole").xpos + [0.1, 0.0, 0.0])
        tip = sim.geom("tip").xpos if isinstance(self, Swapped) else sim.body("pole").xpos
        force = sim.contact_forces()[:, 1]
        return np.concatenate(
            [np.sin(sim.qpos), 0.1 * sim.qvel, tip, dist, moves[:, :, 0], force], 1
        )

    def act(self, sim, action):
        """Push as well."""
        sim.body("pole").xfrc_applied[:, 0] = 0.1 * sim.which
        return super().act(sim, action)

    def reward(self, sim, action):
        """Upright."""
        return np.cos(sim.qpos[:, 0])

    def ended(self, sim):
        """It lies."""
        return np.abs(sim.qpos[:, 0]) > 1.6


class Swapped(Rods):
    """Each of two models reads what the other one has at another place."""

    def models(self):
        """A rod whose geometries are named in another order."""
        return [
            TEXTS[0],
            TEXTS[0].replace('"rod"', '"r"').replace('"tip"', '"rod"').replace('"r"', '"tip"'),
        ]


def only(which: int) -> type[Rods]:
    """A task with one of the models, whose rollouts draw and push as those of `Rods` that have
    it.
    """

    class Only(Rods):
        xml = TEXTS[which]

        def models(self):
            return []

        def prepare(self, sim, rngs):
            for rng in rngs:
                _ = rng and rng.integers(3)
            super().prepare(sim, rngs)

        def act(self, sim, action):
            sim.body("pole").xfrc_applied[:, 0] = 0.1 * which
            return Task.act(self, sim, action)

    return Only


def new_runner(kind: type[Task] = Rods, size: int = 64) -> Runner:
    task = kind()
    spec, config = specification(task), FeaturesConfig(features=5)
    constants = Direct.draw(config, spec, np.random.default_rng(0))
    return Runner(task, Direct(config, spec, constants), lambda model: BatchEngine(model, size))


def run(runner: Runner, rows: Any = slice(None)) -> Rollouts:
    theta = np.random.default_rng(1).normal(0.0, 0.5, (len(SEEDS), runner.policy.size))
    indices = np.arange(len(SEEDS))[rows]
    return runner.rollouts(theta[indices], [SEEDS[i] for i in indices])


def bits(rollouts: Rollouts, row: int) -> dict[str, bytes]:
    arrays = {
        **{f"start {name}": values for name, values in rollouts.start.items()},
        **rollouts.frames,
    }
    arrays |= {
        name: getattr(rollouts, name)
        for name in ("returns", "steps", "ended", "failed", "terms", "actions")
    }
    return {name: np.ascontiguousarray(values[row]).tobytes() for name, values in arrays.items()}


@pytest.fixture(scope="module")
def mixed() -> Rollouts:
    return run(new_runner())


def test_each_row_has_the_bits_of_its_model_alone(mixed: Rollouts) -> None:
    """Also after perturbations, which mujoco.batch itself makes for one model only."""
    assert mixed.which[2] == 0
    assert set(mixed.which.tolist()) == {0, 1, 2}
    assert 0 < mixed.ended.sum() < len(SEEDS)
    for which in range(3):
        alone = run(new_runner(only(which)))
        for row in np.flatnonzero(mixed.which == which).tolist():
            assert bits(mixed, row) == bits(alone, row)


@pytest.mark.parametrize("rows", [slice(None, None, -1), slice(3, 7), [2], [8], [0, 4]])
def test_no_row_depends_on_its_neighbours(mixed: Rollouts, rows: Any) -> None:
    rollouts = run(new_runner(), rows)
    for at, row in enumerate(np.arange(len(SEEDS))[rows].tolist()):
        assert bits(rollouts, at) == bits(mixed, row)


def test_nor_on_the_engines_size_nor_on_what_it_simulated_before(mixed: Rollouts) -> None:
    runner = new_runner(size=3)
    for rollouts in (run(runner), run(runner)):
        assert all(bits(rollouts, row) == bits(mixed, row) for row in range(len(SEEDS)))


def test_models_of_one_layout_share_a_batch() -> None:
    engine = Rods().engine(BatchEngine)
    assert isinstance(engine, MixedEngine)
    assert [part.models for part in engine._parts] == [[0, 1], [2]]


def test_a_rollout_shows_its_own_model(mixed: Rollouts) -> None:
    runner = new_runner()
    [channel] = [each for each in runner.spec.channels if each.name == MODEL]
    assert channel.labels == ("long", "short", "knobbed")
    for row, which in enumerate(mixed.which.tolist()):
        trajectory = runner.trajectory(mixed, row)
        assert trajectory.fits(runner.spec.shapes(len(runner.scene.bodies)))
        assert (trajectory.channels[MODEL].argmax(axis=1) == which).all()
        places = Scene(runner.task.simulated[which]).poses(whole(mixed, row)["qpos"])
        assert trajectory.bodies.tobytes() == places.astype("<f4").tobytes()
    models = {geometry.name: geometry.models for geometry in runner.scene.geometries()}
    parts = {
        "rod-0": (0,),
        "rod-1": (1,),
        "rod-2": (2,),
        "tip-0": (0,),
        "tip-1": (1,),
        "tip-2": (2,),
        "knob-2": (2,),
    }
    assert models == {"floor": (), **parts}


def with_models(*models: Any, **methods: Any) -> type[Rods]:
    return type("Given", (Rods,), {"models": lambda self: list(models), **methods})


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (
            with_models(TEXTS[0], TEXTS[1].replace("-1.5 1.5", "-1 1")),
            r"model 'short' has ctrlrange \[\[-1.0, 1.0\]\]",
        ),
        (
            with_models(TEXTS[0], TEXTS[1].replace("0.01", "0.02")),
            "model 'short' has timestep 0.02, but the first",
        ),
        (
            with_models(TEXTS[0], TEXTS[1].replace('"pole"', '"rod"')),
            "'short' has bodies with geometries",
        ),
        (
            with_models(TEXTS[0], TEXTS[1].replace('"hinge"', '"joint"')),
            r"'short' has joints \['joint'\], but the first model \['hinge'\]",
        ),
        (
            with_models(TEXTS[0], TEXTS[1].replace("<motor", '<motor name="m"')),
            r"'short' has actuators \['m'\], but the first model \['hinge'\]",
        ),
        (
            with_models(TEXTS[0], 3),
            "models gave .*; expected a list of MJCF texts or compiled models",
        ),
        (with_models(TEXTS[0], "<mujoco"), "Given"),
    ],
)
def test_models_that_do_not_go_together_are_one_line(kind: type[Task], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        specification(kind())


def test_what_has_other_shapes_or_places_is_one_line() -> None:
    with pytest.raises(
        TaskError,
        match=r"sim.geom_xpos has other shapes in other models: \(3, 3\) of long, \(4, 3\) of",
    ):
        specification(with_models(*TEXTS, observe=lambda self, sim: sim.geom_xpos[:, 0])())
    with pytest.raises(
        TaskError, match="geom 'tip' has other places in the arrays of other models"
    ):
        specification(Swapped())
    with pytest.raises(TaskError, match="which gave 3; expected the index of a model, 0 to 2"):
        run(
            new_runner(
                with_models(*TEXTS, observe=lambda self, sim: sim.qpos, which=lambda self, rng: 3)
            )
        )
