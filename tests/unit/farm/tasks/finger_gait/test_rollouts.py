"""The gait's rollouts equal single ones in a plain mj_step loop, bit for bit; and their returns."""

import copy
import functools

import mujoco
import numpy as np
import pytest

from farm import plugins
from farm.errors import ConfigError
from farm.policies.base import Policy
from farm.runner import Runner
from farm.tasks.base import Record
from farm.tasks.finger_gait import touch
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, GRIPS, LOWER, UPPER
from farm.tasks.finger_gait.holding import CLOSING, PRESSES, RAMP, SETTLE, SUBSTEPS, moved, touching
from farm.tasks.finger_gait.observations import Felt
from farm.tasks.finger_gait.rewards import WEIGHTS
from farm.tasks.finger_gait.sensing import Perturbation, SensingConfig
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.rollouts import Rollouts, discounted

POLICIES = ("direct", "projected", "kernel", "cosine")
CENTRE = {"direct": 0.0, "cosine": np.pi / 2, "projected": 1.0, "kernel": 0.6}
SPREAD = {"direct": 0.2, "cosine": 0.2, "projected": 2.0, "kernel": 0.3}
"""Mean and standard deviation of parameters with which some rollouts drop the object and some do
not.
"""


@functools.cache
def new_runner(policy="projected", **settings) -> Runner:
    """A runner that tests share: no run leaves anything behind (a test of the loop says so)."""
    task = FingerGait(FingerGaitConfig(**settings))
    kind, spec = plugins.find("policies", policy).target, task.spec()
    config = kind.Config() if policy == "kernel" else kind.Config(features=50)
    return Runner(task, kind(config, spec, kind.draw(config, spec, np.random.default_rng(0))))


def parameters(policy, runner, count, seed=1):
    return np.random.default_rng(seed).normal(
        CENTRE[policy], SPREAD[policy], (count, runner.policy.size)
    )


class Fixed(Policy):
    """The same action at every step, whatever the state."""

    size = 8

    def act(self, prepared, x):
        """The parameters themselves."""
        assert len(prepared) == len(x)
        return prepared


def loaded(name):
    return FingerGait(FingerGaitConfig(object=name)).hand


def fixed(value, seeds=(None,), physics=False, **settings) -> Rollouts:
    runner = new_runner(**settings)
    other = copy.copy(runner)
    other.policy = Fixed(Fixed.Config(), runner.spec, {})
    return other.rollouts(
        np.tile(value, (len(seeds), 1)).astype(float), list(seeds), physics=physics
    )


def trials(count):
    return [(4, 0, i, 0) for i in range(count)]


# ---------------- a plain reference, one rollout at a time


@functools.cache
def grasp(name="bar"):
    grasping = Grasping(loaded(name))
    return {fingers: grasping.command(fingers) for fingers in ((), *GRIPS.values())}


def plain_measure(data):
    """Joint positions and the object's pose, normal forces (3, 4), where they act in the world (3,
    4, 3), fingertips' positions (3, 3) and axes (3, 9).
    """
    force, contact = np.zeros((3, 4)), np.zeros((3, 4, 3))
    sites = [data.site(f"{finger}_tip") for finger in FINGERS]
    for f, finger in enumerate(FINGERS):
        for c, row in enumerate(data.sensor(finger).data.reshape(4, 7)):
            force[f, c], contact[f, c] = row[1] if row[0] > 0 else 0.0, row[4:]
    return (
        data.qpos.copy(),
        force,
        contact,
        *(np.array([getattr(s, n) for s in sites]) for n in ("xpos", "xmat")),
    )


def plain_images(force, contact, tips, axes):
    """Spread the forces where they act in the fingertips' frames, (3, 18)."""
    place = np.zeros((3, 4, 3))
    for f, c in np.ndindex(3, 4):
        away, basis = contact[f, c] - tips[f], axes[f].reshape(3, 3)
        for k in range(3):
            place[f, c, k] = basis[0, k] * away[0] + basis[1, k] * away[1] + basis[2, k] * away[2]
    return touch.image(force, place)


def plain_close(model, commands, displacement):
    """Close a grip round the frozen object and let it go."""
    data, waiting = mujoco.MjData(model), grasp()[()]
    data.qpos[:8] = waiting
    data.qpos[8:11] += displacement
    data.mocap_pos[0], data.mocap_quat[0] = data.qpos[8:11], data.qpos[11:]
    for t in range(CLOSING):
        data.ctrl[:] = waiting + (commands - waiting) * min(1.0, (t + 1) / RAMP)
        mujoco.mj_step(model, data)
    data.eq_active[0] = 0
    return data


@functools.cache
def plain_goal(grip):
    """The demonstration of a grip."""
    model = loaded("bar").model
    data = plain_close(model, grasp()[GRIPS[grip]], np.zeros(3))
    for _ in range(SETTLE):
        mujoco.mj_step(model, data)
    qpos, *felt = plain_measure(data)
    image = plain_images(*felt)
    return Felt(joints=qpos[:8], images=image, points=touch.contact_points(image))


def plain_observation(task, joints, *felt):
    images = plain_images(*felt)[None]
    points = touch.contact_points(images)
    parts = {
        "joints": joints[None],
        "contacts": points.reshape(1, -1),
        "tactile": images.reshape(1, -1),
    }
    return np.concatenate([parts[part] for part in task.config.state.split("+")], axis=1)


def plain_rollout(runner, theta, seed):
    """Returns, steps, actions and frames of one rollout, stepped on its own."""
    task, steps = runner.task, runner.task.steps
    draw = Perturbation.draw(np.random.default_rng(seed), steps, SensingConfig())
    perturbation = Perturbation.none(steps) if seed is None else draw
    model = copy.copy(loaded("bar").model)
    body = model.body("object").id
    model.geom_friction[:] *= perturbation.friction
    model.body_mass[body] *= perturbation.mass
    model.body_inertia[body] *= perturbation.mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    start = last = grasp()[GRIPS[task.config.start_grip]]
    data = plain_close(model, start, perturbation.displacement)
    first = now = plain_measure(data)
    frames = [np.zeros((1, steps, *part.shape)) for part in now]
    actions, prepared, count = np.zeros((1, steps, 8)), runner.policy.prepare(theta[None]), steps
    for t in range(steps):
        x = plain_observation(task, now[0][:8] + perturbation.noise[t], *now[1:])
        actions[:, t] = runner.policy.act(prepared, x)
        base = {"offset": start, "absolute": 0.0, "increment": last}[task.config.action]
        target = np.nan_to_num(base + actions[0, t], nan=0.0)
        limits = (LOWER, UPPER) if task.config.clip else (-1e6, 1e6)
        last = data.ctrl[:] = np.clip(target, *limits)
        last = last.copy()
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
        now = plain_measure(data)
        for rows, part in zip(frames, now, strict=True):
            rows[0, t] = part
        if not touching(now[1]):
            count = t + 1
            break
    task.goals, goals = [plain_goal(task.config.goal_grip)], task.goals
    names = dict(zip(("qpos", "force", "contact", "tip", "axes"), frames, strict=True))
    record = Record(
        names,
        {"qpos": first[0][None]},
        actions,
        np.array([count]),
        np.array([False]),
        np.zeros(1, int),
    )
    score = task.score(record)
    task.goals = goals
    returns, _ = discounted(score.terms, task.config.gamma, task.return_scale)
    return {
        "returns": returns,
        "terms": score.terms,
        "actions": actions,
        "success": score.success,
        **names,
    }


def assert_plain(runner, theta, seeds):
    rollouts = runner.rollouts(theta, seeds)
    for i, seed in enumerate(seeds):
        plain = plain_rollout(runner, theta[i], seed)
        results = {
            name: getattr(rollouts, name) for name in ("returns", "terms", "actions", "success")
        }
        for name, values in (results | rollouts.frames).items():
            if name in plain:
                assert values[i].tobytes() == plain[name][0].tobytes(), f"{name} of rollout {i}"
    return rollouts


@pytest.mark.parametrize("policy", POLICIES)
def test_a_batch_equals_plain_rollouts_bit_for_bit(policy):
    runner = new_runner(policy, state="joints+tactile")
    assert_plain(runner, parameters(policy, runner, 4), [None, *trials(2), None])


@pytest.mark.slow
def test_the_rollouts_compared_drop_and_hold():
    for policy in POLICIES:
        runner = new_runner(policy)
        steps = runner.rollouts(parameters(policy, runner, 32), [None] * 32).steps
        assert 0 < (steps == 15).sum() < 32, policy


@pytest.mark.parametrize(
    "settings",
    [
        {"start_grip": "index+middle+thumb", "goal_grip": "index+thumb"},
        {"state": "tactile", "reward": "basic", "weights": "direct", "steps": 22, "gamma": 0.9},
        {"state": "joints+contacts", "action": "absolute"},
        {"action": "increment"},
    ],
    ids=lambda settings: "-".join(settings),
)
def test_other_settings_equal_plain_rollouts(settings):
    runner = new_runner("direct", **settings)
    assert_plain(runner, parameters("direct", runner, 3), [None, *trials(2)])


def test_huge_unclipped_actions_equal_plain_rollouts():
    runner = new_runner("direct", clip=False)
    theta = parameters("direct", runner, 4) * np.array([1e3, 1e9, 1e160, 1e307])[:, None]
    rollouts = assert_plain(runner, theta, [None] * 4)
    assert rollouts.clamped.tolist() == [False, True, True, True]
    assert (rollouts.returns[1:] == -1e12).all()


# ---------------- what the task is worth


def goal_offset():
    return grasp()[GRIPS["index+middle+thumb"]] - grasp()[GRIPS["index+thumb"]]


def test_holding_still_the_demonstration_and_a_drop():
    still, goal, drop = fixed(np.zeros(8)), fixed(goal_offset()), fixed(np.full(8, -2.0))
    assert still.returns[0] == pytest.approx(-5.4, abs=1.0)
    assert (still.success[0], still.steps[0], still.ended[0]) == (False, 15, False)
    assert -0.3 < goal.returns[0] < 0
    assert goal.success[0]
    assert drop.steps[0] <= 2
    assert drop.ended[0]
    assert drop.returns[0] == pytest.approx(-42.0, abs=4.0)
    assert drop.terms[0, drop.steps[0] - 1, 4] == -WEIGHTS["projected"].drop
    assert np.count_nonzero(drop.terms[0, :, 4]) == 1


@pytest.mark.parametrize("grip", ["index+thumb", "index+middle+thumb"])
def test_a_grip_holds_for_three_seconds_by_itself(grip):
    rollouts = fixed(np.zeros(8), physics=True, start_grip=grip, goal_grip=grip, steps=30)
    shift, turn = moved(rollouts.frames["qpos"][0, :, 8:], rollouts.start["qpos"][:, 8:])
    assert shift.max() < 0.005
    assert np.rad2deg(turn.max()) < 15.0
    press = rollouts.frames["force"][0].sum(axis=-1)
    for f, finger in enumerate(FINGERS):
        assert (press[:, f] > PRESSES).all() if finger in GRIPS[grip] else not press[:, f].any(), (
            finger
        )
    assert rollouts.success[0]


def test_the_demonstrated_grip_succeeds_when_perturbed_and_the_start_grip_does_not():
    assert fixed(goal_offset(), trials(100)).success.sum() >= 95
    still = fixed(np.zeros(8), trials(100))
    assert not still.success.any()
    assert (still.steps == 15).sum() >= 95


def test_friction_of_all_rollouts_is_a_setting():
    slippery = fixed(goal_offset(), [None, (1, 2, 3, 4)], friction=0.5)
    default = fixed(goal_offset(), [None, (1, 2, 3, 4)])
    assert (slippery.frames["qpos"] != default.frames["qpos"]).any(axis=(1, 2)).all()


# ---------------- grips are found, not typed in

BODY = """<mujoco model="thing"><worldbody>
  <body name="object" pos="{place}"><freejoint name="object"/>{geom}</body>
</worldbody></mujoco>"""
GEOM = (
    '<geom name="thing" {kind} mass="{mass}" contype="2" conaffinity="1" condim="4" friction="1'
    ' 0.01 0.001"/>'
)


@pytest.fixture
def thing(tmp_path):
    """Make an object file of one's own."""

    def make_thing(kind, place="0.08 0.04 0.02", mass=0.05):
        path = tmp_path / "thing.xml"
        path.write_text(BODY.format(place=place, geom=GEOM.format(kind=kind, mass=mass)))
        return str(path)

    return make_thing


@pytest.mark.parametrize(
    ("size", "place"),
    [
        pytest.param("0.008 0.06 0.008", "0.08 0.04 0.02", id="thin"),
        pytest.param("0.014 0.06 0.014", "0.08 0.04 0.02", id="thick", marks=pytest.mark.slow),
        pytest.param("0.011 0.06 0.011", "0.08 0.04 0.025", id="higher", marks=pytest.mark.slow),
        pytest.param("0.011 0.06 0.011", "0.076 0.038 0.018", id="nearer"),
    ],
)
def test_a_grip_is_found_for_an_object_of_ones_own(thing, size, place):
    name = thing(f'type="box" size="{size}"', place)
    hand = loaded(name)
    grasping = Grasping(hand)
    for finger in FINGERS:
        assert 0 <= contact_gap(hand, grasping.contact, finger) < 1e-6, finger
    offset = grasping.command(GRIPS["index+middle+thumb"]) - grasping.command(GRIPS["index+thumb"])
    assert fixed(offset, object=name).success[0]


def contact_gap(hand, joints, finger):
    data = mujoco.MjData(hand.model)
    data.qpos[:8] = joints
    mujoco.mj_kinematics(hand.model, data)
    tip, (geom,) = hand.model.geom(f"{finger}_tip").id, hand.object_geoms
    return mujoco.mj_geomDistance(hand.model, data, tip, geom, 1.0, None)


def test_waiting_fingers_keep_their_distance():
    for finger in FINGERS:
        assert contact_gap(loaded("bar"), grasp()[()], finger) == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize(
    ("kind", "mass", "line"),
    [
        ('type="sphere" size="0.08"', 0.05, r"is in the way of the \w+ finger"),
        ('type="box" size="0.011 0.06 0.011"', 5.0, r"'index\+thumb' does not hold object"),
        ('type="bok"', 1.0, "MuJoCo refuses the model"),
    ],
)
def test_an_object_that_cannot_be_gripped_is_a_clear_error(thing, kind, mass, line):
    with pytest.raises(ConfigError, match=line):
        new_runner(object=thing(kind, mass=mass))


def test_settings_that_name_nothing_are_clear_errors(tmp_path):
    words = (
        r"'middle\+thumb' does not hold object 'bar' in pose 'opposed', pressing with 3 N"
        r" \(middle\) and 6.5 N"
    )
    with pytest.raises(ConfigError, match=words):
        new_runner(start_grip="middle+thumb")
    with pytest.raises(ConfigError, match="unknown object 'spoon'; known are .*bar"):
        new_runner(object="spoon")
    with pytest.raises(ConfigError, match="cannot read the object .*none.xml"):
        new_runner(object=str(tmp_path / "none.xml"))


def test_a_command_does_not_depend_on_what_was_asked_before():
    grasping, commands = Grasping(loaded("bar")), grasp()
    three = commands[GRIPS["index+middle+thumb"]]
    for first in commands:
        for fingers in commands:
            grasping.command(first)
            assert grasping.command(fingers).tobytes() == commands[fingers].tobytes()
            for finger in FINGERS:
                joints = list(FINGER_JOINTS[finger])
                same = three if finger in fingers else commands[()]
                np.testing.assert_array_equal(commands[fingers][joints], same[joints])
