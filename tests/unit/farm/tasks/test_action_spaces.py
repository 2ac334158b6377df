"""Action spaces: what their numbers do to controls, what is seen of them, and mistakes in a
declaration.
"""

import math

import mujoco
import numpy as np
import pytest

import farm
from farm import seeds
from farm.errors import ConfigError
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks import loop
from farm.tasks.actions.numbers import described
from farm.tasks.base import Task
from farm.tasks.loop import Batch
from farm.tasks.probe import specification

LEGS = ("FR", "FL", "RR", "RL")
LEG = """<body name="{0}" pos="{1} 0 0">
  <joint name="{0}_hip" axis="0 1 0" armature="0.05"/><geom size="0.05"/>
  <body name="{0}_shank" pos="0 0 -0.2">
    <joint name="{0}_knee" axis="0 1 0" armature="0.05"/><geom size="0.05"/>
    <site name="{0}_foot" pos="0 0 -0.2"/>
  </body>
</body>"""
SERVOS = """
  <position name="{0}_hip" joint="{0}_hip" kp="20" kv="1" ctrlrange="-1 1"/>
  <position name="{0}_knee" joint="{0}_knee" kp="20" kv="1" ctrlrange="-2 2"/>"""
BODIES = "".join(LEG.format(leg, i) for i, leg in enumerate(LEGS))
ACTUATORS = "".join(SERVOS.format(leg) for leg in LEGS)
POSE = " ".join(["0.4 -0.8"] * 4)
XML = f"""<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>{BODIES}</worldbody>
  <actuator>{ACTUATORS}</actuator>
  <keyframe><key name="home" qpos="{POSE}"/></keyframe>
</mujoco>"""
HOME = np.tile([0.4, -0.8], 4)


class Legs(Task):
    """Four legs of two joints, each with a servo."""

    xml = XML
    steps, substeps = 12, 5

    def reset(self, sim, row, rng):
        """Begin in the pose, or near it."""
        sim.qpos[row] = HOME if rng is None else HOME + rng.uniform(-0.2, 0.2, 8)

    def observe(self, sim):
        """Positions."""
        return np.array(sim.qpos)

    def reward(self, sim, action):
        """Anything."""
        return sim.qpos.sum(axis=1)

    def script(self, sim):
        """Servos' targets, half of the pose."""
        return np.tile(0.5 * HOME, (len(sim), 1))


def unequal(task, sim):
    """Some rollouts end early."""
    return (np.abs(1000.0 * sim.qpos[:, 0]) % 1.0 < 0.5) & (sim.t > 5)


def legs(space, **more) -> Task:
    return type("Legs", (Legs,), {"actions": space, **more})()


def batch(task: Task, seeds) -> Batch:
    """Rollouts whose outputs have all been asked for once: an engine begins anew when one is
    new.
    """
    sim = Sim(task.engine(lambda model: BatchEngine(model, len(seeds))))

    def begun() -> Batch:
        task.setup(sim)
        tried = Batch(task, sim, seeds)
        tried.observe()
        tried.step(np.zeros((len(seeds), task.action_size)))
        return Batch(task, sim, seeds)

    made: Batch = loop.again(begun)
    return made


def controls(space, *actions, task: Task | None = None) -> np.ndarray:
    """Controls of one nominal rollout that gets these actions in turn, (T, nu)."""
    running = batch(task or legs(space), [None])
    out = []
    for action in actions:
        running.step(np.array([action], dtype=float))
        out.append(running.sim.engine.field("ctrl")[0].copy())
    return np.array(out)


RHYTHM = farm.Rhythm(LEGS, "trot", swing={"hip": 0.3}, lift={"knee": -0.6}, pose="home")
SPACES = {
    "offsets": farm.Offsets("home", 0.3),
    "some": farm.Offsets("home", 0.3, ("F*_hip",)),
    "moves": farm.Moves("FL_foot", ("x", "z"), 0.01),
    "held": farm.Moves("FL_foot", ("x",), 0.01, held=("z",)),
    "script": farm.Residual("script", 0.2),
    "residual": farm.Residual(RHYTHM, 0.1, ("*_hip",)),
    "synergies": farm.Synergies(np.eye(2, 8), of=farm.Offsets("home", 0.3)),
    "mirrored": farm.Mirrored({"FR": "FL", "RR": "RL"}, flip=("hip",)),
    "rhythm": RHYTHM,
    "free": farm.Rhythm(LEGS, "free", swing={"hip": 0.3}),
    "clock": farm.Clock(0.1),
    "weights": farm.Clock(0.1, weights=4, of=RHYTHM),
}


@pytest.mark.parametrize("name", SPACES)
def test_a_rollout_has_the_same_bits_alone_and_among_others_that_end(name):
    task = legs(SPACES[name], ended=unequal)
    rng = np.random.default_rng(1)
    seeds = [None, (1,), (2,), (3,), (4,)]
    actions = rng.uniform(-1.5, 1.5, (task.steps, len(seeds), task.action_size))

    def observed(rows):
        running = batch(task, [seeds[i] for i in rows])
        seen = {i: [] for i in rows}
        while not running.over:
            x = running.observe()
            active = [rows[k] for k in running.active]
            for i, row in zip(active, x, strict=True):
                seen[i].append(row)
            running.step(actions[running.sim.t][active])
        return seen

    together = observed(range(5))
    assert {len(each) for each in together.values()} != {task.steps}
    for i in range(5):
        assert np.array_equal(together[i], observed([i])[i])
    spec = specification(task)
    assert (spec.action, spec.observation) == (task.action_size, together[0][0].size)
    assert len(described(task, spec.action)) == spec.action
    names = tuple(farm.Quantity(f"joint {i}") for i in range(8))
    assert len(task.space.names(names)) == spec.observation


def test_offsets_are_a_pose_and_a_range_within_the_actuators_range():
    offsets = controls(farm.Offsets("home", 0.3), [1.0] * 8, [9.0] * 8, [np.nan] * 8)
    assert np.allclose(offsets, [HOME + 0.3, HOME + 0.3, HOME])
    assert controls(farm.Offsets("home", 5.0), [1.0] * 8)[0].tolist() == [1.0, 2.0] * 4
    front = controls(farm.Offsets("home", 0.3, ("F*_hip",)), [1.0, -1.0])[0] - HOME
    assert np.allclose(front, [0.3, 0, -0.3, 0, 0, 0, 0, 0])


def test_a_pose_is_numbers_or_where_the_model_starts():
    assert controls(farm.Offsets([0.1] * 8, 0.3), [0.0] * 8)[0].tolist() == [0.1] * 8
    assert controls(farm.Offsets(), [0.0] * 8)[0].tolist() == [0.0] * 8


def test_a_site_moves_along_its_axes_and_stays_along_those_held():
    task = legs(farm.Moves("FL_foot", ("x",), 0.005, held=("z",)), steps=60)
    running = batch(task, [None])
    start = running.sim.site("FL_foot").xpos.copy()
    for _ in range(20):
        running.step(np.array([[1.0]]))
    for _ in range(30):
        running.step(np.array([[0.0]]))
    running.sim.forward()
    moved = running.sim.site("FL_foot").xpos - start
    assert 0.08 < moved[0, 0] < 0.11  # 20 moves of 5 mm
    assert abs(moved[0, 2]) < 0.005
    others = np.delete(running.sim.qpos[0], [2, 3])
    assert np.allclose(others, np.delete(np.zeros(8), [2, 3]), atol=0.05)


def test_damped_least_squares_is_that_of_linear_algebra():
    from farm.tasks.actions.moves import _least_squares

    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(5, 3, 7))
    error = rng.normal(size=(5, 3))
    for j, e, found in zip(jacobian, error, _least_squares(jacobian, error, 0.1), strict=True):
        expected = j.T @ np.linalg.solve(j @ j.T + 0.01 * np.eye(3), e)
        assert np.allclose(found, expected, rtol=1e-10)


def test_corrections_are_added_to_a_script_and_to_a_space():
    assert np.allclose(controls(farm.Residual("script", 0.2), [1.0] * 8)[0], 0.5 * HOME + 0.2)
    both = controls(farm.Residual(RHYTHM, 0.1, ("*_hip",)), [0.0, -1.0, -1.0, 1, 1, 1, 1])[0]
    assert np.allclose(both - HOME, [0.1, 0.0] * 4)


def test_synergies_and_mirrored_limbs():
    weights = [[1.0, 0.5] + [0.0] * 6, [0.0] * 7 + [1.0]]
    space = farm.Synergies(weights, of=farm.Offsets("home", 0.2))
    assert np.allclose(controls(space, [1.0, -1.0])[0] - HOME, [0.2, 0.1, 0, 0, 0, 0, 0, -0.2])
    space = farm.Mirrored({"FR": "FL", "RR": "RL"}, flip=("hip",), of=farm.Offsets("home", 0.1))
    assert [each.name for each in legs(space).space.quantities] == [
        "FR_hip",
        "FR_knee",
        "RR_hip",
        "RR_knee",
    ]
    moved = controls(space, [1.0, 1.0, -1.0, 0.5])[0] - HOME
    assert np.allclose(moved, [0.1, 0.1, -0.1, 0.1, -0.1, 0.05, 0.1, 0.05])


def test_a_trot_moves_opposite_legs_together():
    task = legs(RHYTHM)
    moved = controls(None, *[[0.0, 0.0, 0.0]] * 10, task=task) - HOME
    turns = np.arange(1, 11) * task.period * 2.0  # 2 Hz
    expected = {
        "hip": 0.3 * np.cos(2 * np.pi * turns),
        "knee": -0.6 * np.maximum(np.sin(2 * np.pi * turns), 0),
    }
    for i, joint in enumerate(("hip", "knee")):
        assert np.allclose(moved[:, i], expected[joint])
        assert np.allclose(moved[:, 6 + i], expected[joint])  # RL with FR
        assert np.allclose(moved[:, 2 + i], moved[:, 4 + i])
    assert np.allclose(moved[:, 2], -moved[:, 0])


def test_frequency_and_amplitudes_follow_the_action_and_the_phase_is_seen():
    task = legs(RHYTHM)
    running = batch(task, [None])
    assert running.observe()[0, -2:].tolist() == [0.0, 1.0]
    running.step(np.array([[1.0, -1.0, 1.0]]))  # 3 Hz, no swing, twice the lift
    ctrl = running.sim.engine.field("ctrl")[0]
    angle = 2 * math.pi * 3.0 * task.period
    assert np.allclose(running.observe()[0, -2:], [math.sin(angle), math.cos(angle)])
    assert ctrl[0] == HOME[0]
    assert ctrl[1] == pytest.approx(HOME[1] - 1.2 * math.sin(angle))


def test_a_free_gait_has_a_phase_for_each_limb_but_the_first():
    space = farm.Rhythm(LEGS, "free", swing={"hip": 0.3})
    names = [each.name for each in legs(space).space.quantities]
    assert names == ["frequency", "swing", "lift", "phase FL", "phase RR", "phase RL"]
    moved = controls(space, [0, 0, 0, 1.0, 0.0, -1.0])[0][::2]
    assert np.allclose(moved[[0, 2]], moved[0])
    assert np.allclose(moved[[1, 3]], -moved[0])


def test_a_clock_is_seen_and_its_weights_add_up_to_the_observation():
    task = legs(farm.Clock(0.1, weights=4))
    running = batch(task, [(3,)])
    for _ in range(10):
        x = task.observe(running.sim)[0]
        copies = running.observe()[0].reshape(4, 9)
        assert np.allclose(copies.sum(axis=0), [*x, 1.0])
        assert np.count_nonzero(copies[:, -1]) <= 2
        running.step(np.zeros((1, 8)))
    plain = batch(legs(farm.Clock(0.1)), [None])
    for t in range(3):
        angle = 2 * math.pi * t * task.period / 0.1
        assert np.allclose(plain.observe()[0, -2:], [math.sin(angle), math.cos(angle)])
        plain.step(np.zeros((1, 8)))


MISTAKES = {
    "no keyframe": (farm.Offsets("hone"), r"no keyframe 'hone'; it has home"),
    "pose": (farm.Offsets([1.0]), r"pose is \[1.0\]; expected 8 numbers"),
    "range": (
        farm.Offsets("home", [0.1, 0.2]),
        r"range is \[0.1, 0.2\]; expected a number above 0, or 8",
    ),
    "negative": (farm.Offsets("home", -0.1), r"range is -0.1; expected a number above 0"),
    "pattern": (
        farm.Offsets("home", 0.1, ("X*",)),
        r"no actuator is called 'X\*'; the model has FR_hip, ",
    ),
    "one name": (farm.Offsets("home", 0.1, "X*"), r"no actuator is called 'X\*'; the model has"),
    "kind": (farm.Offsets(["a"] * 8), r"Offsets: an argument is of the wrong kind for task Legs"),
    "site": (farm.Moves("tip"), r"no site 'tip'; it has FR_foot, "),
    "axis": (farm.Moves("FL_foot", ("up",)), r"'up' is no axis"),
    "both": (farm.Moves("FL_foot", ("x",), held=("x",)), r"moved and held"),
    "damping": (
        farm.Moves("FL_foot", ("x",), damping=0.0),
        r"damping is 0; expected a number above 0",
    ),
    "method": (farm.Residual("play"), r"task Legs has no method play\(self, sim\)"),
    "made of": (farm.Residual(3), r"Residual: it is made of 3; expected an action space"),
    "of a class": (
        farm.Clock(0.1, of=farm.Offsets),
        r"Clock: it is made of <class .*; expected an action space, such as farm.Offsets\(\)",
    ),
    "weights": (farm.Synergies([[1.0, 2.0]]), r"shape \(1, 2\); expected \(k, 8\)"),
    "partner": (farm.Mirrored({"FR": "XX"}), r"there is no 'XX_hip'"),
    "side": (farm.Mirrored({"left": "right"}), r"nothing with 'left' in its name"),
    "flip": (farm.Mirrored({"FR": "FL"}, flip=("ankle",)), r"has 'ankle' in its name"),
    "chain": (
        farm.Mirrored({"FR": "FL", "FL": "RR"}),
        r"Mirrored: 'FL_hip' would lead and follow",
    ),
    "itself": (farm.Mirrored({"FR": "FR"}), r"Mirrored: 'FR_hip' would lead and follow"),
    "no limbs": (farm.Rhythm((), (), swing={"hip": 0.1}), r"limbs are none; expected different"),
    "twice": (farm.Rhythm(("FR", "FR"), "alternate", swing={"hip": 0.1}), r"limbs are FR, FR"),
    "still": (farm.Rhythm(LEGS, swing={}), r"swing names no joint; expected one, as in"),
    "endless": (farm.Rhythm(LEGS, swing={"hip": math.nan}), r"hip moves by nan; expected a finite"),
    "two": (farm.Rhythm(LEGS, swing={"hip": [1, 2]}), r"hip moves by \[1, 2\]; expected a finite"),
    "name": (
        farm.Rhythm(LEGS, swing={"hip": 0.1}, name="{leg}_{joint}"),
        r"name is '\{leg\}_\{joint\}'; expected a text with \{limb\} and \{joint\}",
    ),
    "limbs": (
        farm.Rhythm((*LEGS, "tail"), swing={"hip": 0.1}),
        r"for 4 limbs, but there are 5: FR, FL, RR, RL, tail",
    ),
    "legs": (
        farm.Rhythm((*LEGS, "tail"), (0, 0, 0, 0, 0), swing={"hip": 1.0}),
        r"no actuator is called 'tail_hip'",
    ),
    "gait": (farm.Rhythm(LEGS, "gallop", swing={"hip": 0.1}), r"gait is 'gallop'; expected trot, "),
    "order": (
        farm.Rhythm(LEGS, swing={"hip": 0.1}, frequency=(3.0, 1.0)),
        r"frequency is \(3.0, 1.0\); expected two numbers, 0 or more, in order",
    ),
    "one end": (
        farm.Rhythm(LEGS, swing={"hip": 0.1}, frequency=2.0),
        r"frequency is 2.0; expected",
    ),
    "fast": (
        farm.Rhythm(LEGS, swing={"hip": 0.1}, frequency=(1.0, 90.0)),
        r"it must stay below 50 Hz",
    ),
    "joint": (farm.Rhythm(LEGS, swing={"toe": 0.1}), r"no actuator is called 'FR_toe'"),
    "clock": (farm.Clock(0.001), r"period is 0.001 s; expected at least two control steps"),
    "bins": (farm.Clock(0.1, weights=1), r"weights is 1; expected 0, or"),
    "class": (farm.Offsets, r"actions is a class; expected an object: Offsets\(\.\.\.\)"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_a_declaration_is_one_line(name):
    space, words = MISTAKES[name]
    with pytest.raises(ConfigError, match=words):
        specification(legs(space))


ACTUATED = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0 0 0.3"/></body></worldbody>
  <actuator>ACTUATOR</actuator><keyframe><key name="bent" qpos="1.5"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("actuator", "pose"),
    [
        ('<position joint="a" kp="20"/>', 1.5),
        ('<position joint="a" kp="20" gear="-2"/>', -3.0),
        ('<motor joint="a" gear="3"/>', 0.0),
        ('<velocity joint="a" kv="2"/>', 0.0),
        ('<intvelocity joint="a" kp="2" actrange="-1 1"/>', 0.0),
        ('<damper joint="a" kv="2" ctrlrange="0 3"/>', 0.0),
    ],
)
def test_servos_hold_the_pose_and_others_get_0_without_a_range_too(actuator, pose):
    task = type(
        "One", (Legs,), {"xml": ACTUATED.replace("ACTUATOR", actuator), "reset": Task.reset}
    )
    for space in (farm.Offsets("bent", 0.3), farm.Residual(farm.Offsets("bent", 0.3), 0.1)):
        made = type("One", (task,), {"actions": space})()
        assert controls(space, np.zeros(made.action_size), task=made) == pytest.approx(pose)


class Mine(farm.ActionSpace):
    def fit(self, task):
        raise ValueError("mine")


def test_errors_of_ones_own_space_and_models_keep_their_place():
    for space in (Mine(), farm.Clock(0.1, of=Mine())):
        with pytest.raises(ValueError, match="mine"):
            specification(legs(space))

    def models(_):
        raise KeyError("leg")

    with pytest.raises(KeyError, match="leg"):
        specification(legs(farm.Offsets("home", 0.1), models=models))


def test_one_name_is_a_list_of_one():
    space = legs(farm.Mirrored({"FR": "FL", "RR": "RL"}, flip="hip")).space
    assert space.sign.tolist() == [1, 1, -1, 1, 1, 1, -1, 1]


def test_a_site_at_another_place_in_another_model_is_one_line():
    swapped = XML.replace('<site name="FL_foot" pos="0 0 -0.2"/>', "").replace(
        '<site name="FR_foot"', '<site name="FL_foot"/><site name="FR_foot"'
    )
    task = legs(farm.Moves("FL_foot", ("x",)), models=lambda _: [XML, swapped])
    with pytest.raises(ConfigError, match="site 'FL_foot', or a joint that moves it, has another"):
        specification(task)


def test_moves_need_position_servos():
    motors = XML.replace("<position", "<motor").replace(' kp="20" kv="1"', "")
    with pytest.raises(ConfigError, match="no position servo moves site 'FL_foot'"):
        specification(legs(farm.Moves("FL_foot"), xml=motors))
    mujoco.MjModel.from_xml_string(motors)


def test_an_environment_shows_and_takes_what_the_space_does():
    pytest.importorskip("gymnasium")
    task = legs(RHYTHM)
    environment = farm.environment(type(task))
    assert environment.observation_space.shape == (10,)
    assert environment.action_space.shape == (3,)
    running = batch(task, [seeds.evaluation_start(0, 7)])
    x, _ = environment.reset(seed=7)
    for k in range(task.steps):
        assert np.array_equal(x, running.observe()[0])
        action = np.array([0.5, -0.2, 0.1 * k])
        x, *_ = environment.step(action)
        running.step(action[None])
    environment.close()


def test_sensors_have_errors_and_the_spaces_own_phase_has_none():
    task = legs(RHYTHM, robust=farm.Robust(noise=0.1, observation_delay=(0.02, 0.02)))
    noisy = batch(task, [(7,)])
    exact = batch(legs(RHYTHM), [(7,)])
    for k in range(4):
        x = noisy.observe()[0]
        expected = exact.observe()[0]
        assert (x[:8] != expected[:8]).any()
        assert np.array_equal(x[8:], expected[8:])
        for running in (noisy, exact):
            running.step(np.full((1, 3), 0.1 * k))
