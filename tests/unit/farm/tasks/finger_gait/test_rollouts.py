"""Simulation against one rollout at a time in a plain mj_step loop, bit for bit; and the grips themselves."""

import copy
import dataclasses
import functools

import mujoco
import numpy as np
import pytest

import assets
from farm.errors import ConfigError
from farm.policies.fourier import CONTROLLERS, Features, Policy, PolicyConfig
from farm.sim import scene as scenes
from farm.tasks.finger_gait import physics as simulation
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, GRIPS
from farm.tasks.finger_gait.physics import CAPACITY, CLOSING, RAMP, SETTLE, Simulation, Stepper
from farm.tasks.finger_gait.rewards import WEIGHTS, Demonstration
from farm.tasks.finger_gait.task import PRESSES, SUBSTEPS, FingerGait, Frames, Perturbation, TaskConfig, moved, touching

# ---------------------------------------------------------------- a plain reference, one rollout at a time


@functools.cache
def scene_of(name):
    return scenes.load(name)


@functools.cache
def grasp(name):
    grasping = Grasping(scene_of(name))
    return {fingers: grasping.command(fingers) for fingers in ((), *GRIPS.values())}


def plain_model(scene, perturbation):
    """Return a copy of the model with friction, mass and inertia scaled, and all that follows from them."""
    model = copy.copy(scene.model)
    if perturbation is not None:
        body = model.body("object").id
        model.geom_friction[:] = model.geom_friction * perturbation.friction
        model.body_mass[body] = model.body_mass[body] * perturbation.mass
        model.body_inertia[body] = model.body_inertia[body] * perturbation.mass
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def plain_measure(data):
    """Return joint positions and the object's pose, normal forces (3, 4) and their places (3, 4, 3)."""
    force, place = np.zeros((3, 4)), np.zeros((3, 4, 3))
    for f, finger in enumerate(FINGERS):
        numbers = data.sensor(finger).data.reshape(4, 7)
        site = data.site(f"{finger}_tip")
        axes = site.xmat.reshape(3, 3)
        for c, row in enumerate(numbers):
            if row[0] > 0:
                force[f, c] = row[1]
                away = row[4:] - site.xpos
                for k in range(3):
                    place[f, c, k] = axes[0, k] * away[0] + axes[1, k] * away[1] + axes[2, k] * away[2]
    return data.qpos.copy(), force, place


def plain_close(model, waiting, commands, displacement):
    """Close a grip round the frozen object and let it go."""
    data = mujoco.MjData(model)
    data.qpos[:8] = waiting
    data.qpos[8:11] += displacement
    data.mocap_pos[0], data.mocap_quat[0] = data.qpos[8:11], data.qpos[11:]
    for t in range(CLOSING):
        data.ctrl[:] = waiting + (commands - waiting) * min(1.0, (t + 1) / RAMP)
        mujoco.mj_step(model, data)
    data.eq_active[0] = 0
    return data


@functools.cache
def plain_goal(name, grip):
    """Return the demonstration of a grip."""
    scene, commands = scene_of(name), grasp(name)
    data = plain_close(scene.model, commands[()], commands[GRIPS[grip]], np.zeros(3))
    for _ in range(SETTLE):
        mujoco.mj_step(scene.model, data)
    qpos, force, place = plain_measure(data)
    image = tactile.image(force, place)
    return Demonstration(joints=qpos[:8], images=image, points=tactile.contact_points(image))


def plain_rollout(config, policy, theta, perturbation, substeps=SUBSTEPS):
    """Return everything about one rollout, stepped on its own."""
    scene, commands = scene_of(config.object), grasp(config.object)
    start = commands[GRIPS[config.start_grip]]
    task = FingerGait(config, plain_goal(config.object, config.goal_grip), start)
    model = plain_model(scene, perturbation)
    displacement = np.zeros(3) if perturbation is None else perturbation.displacement
    data = plain_close(model, commands[()], start, displacement)
    first = now = plain_measure(data)
    parts = SUBSTEPS // substeps
    fine = [np.zeros((1, config.steps * parts, *part.shape)) for part in now]
    control = [np.zeros((1, config.steps, *part.shape)) for part in now]
    actions, targets = np.zeros((1, config.steps, 8)), np.zeros((1, config.steps, 8))
    weights, last, steps = policy.weights(theta[None]), start[None], config.steps
    for t in range(config.steps):
        noise = None if perturbation is None else perturbation.noise[t][None]
        x = task.observe(Frames(*(part[None] for part in now)), noise)
        actions[0, t] = policy.actions(weights, x)[0]
        last = targets[:, t] = policy.targets(actions[:, t], start, last)
        data.ctrl[:] = last[0]
        for k in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            if (k + 1) % substeps == 0:
                for rows, part in zip(fine, plain_measure(data), strict=True):
                    rows[0, t * parts + (k + 1) // substeps - 1] = part
        now = plain_measure(data)
        for rows, part in zip(control, now, strict=True):
            rows[0, t] = part
        if not touching(now[1]):
            steps = t + 1
            break
    outcome = task.judge(Frames(*control), actions, first[0][None, 8:], np.array([steps]), np.array([False]))
    return simulation.Rollouts(outcome, Frames(*(part[None] for part in first)), Frames(*fine), targets, actions)


# ---------------------------------------------------------------- helpers


def leaves(value, path=""):
    """Every array of nested dataclasses, by its path."""
    if isinstance(value, np.ndarray):
        return {path: value}
    out = {}
    for field in dataclasses.fields(value):
        out |= leaves(getattr(value, field.name), f"{path}.{field.name}")
    return out


def assert_rows_equal(rollouts, row, other, other_row):
    """Two rollouts agree in every bit of everything that is known of them."""
    one, two = leaves(rollouts), leaves(other)
    assert one.keys() == two.keys()
    assert len(one) == 17
    for name, values in one.items():
        a, b = values[row], two[name][other_row]
        assert a.dtype == b.dtype, name
        assert a.shape == b.shape, name
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), f"{name} of row {row}"


def make_policy(controller="projected", state_size=8, features=50, seed=0, **options):
    config = PolicyConfig(controller=controller, features=features, **options)
    return Policy(config, state_size, Features.draw(config, state_size, np.random.default_rng(seed)))


@functools.cache
def make(state="joints", threads=1, **options):
    """Return a simulation that tests share: no run leaves anything behind (a test below says so)."""
    return Simulation(TaskConfig(state=state), make_policy(state_size=SIZES[state], **options), threads)


SIZES = {"joints": 8, "joints+contacts": 17, "tactile": 54, "joints+tactile": 62}
CENTRE = {"direct": 0.0, "cosine": np.pi / 2, "projected": 1.0, "kernel": 0.6}
SPREAD = {"direct": 0.2, "cosine": 0.2, "projected": 2.0, "kernel": 0.3}
"""Mean and standard deviation of parameters with which some rollouts drop the object and some do not."""


def parameters(policy, count, seed=1):
    controller = policy.config.controller
    return np.random.default_rng(seed).normal(CENTRE[controller], SPREAD[controller], (count, policy.size))


def perturbations(count, steps=15):
    return [Perturbation.draw(np.random.default_rng([7, i]), steps) for i in range(count)]


class Fixed(Policy):
    """The same action at every step, whatever the state."""

    def __init__(self, value):
        config = PolicyConfig(controller="direct", features=1)
        super().__init__(config, 8, Features.draw(config, 8, np.random.default_rng(0)))
        self.value = value

    def actions(self, weights, x):
        """Return it for every row."""
        assert len(weights) == len(x)
        return np.tile(self.value, (len(x), 1))


def fixed(value, count=1, perturbed=None, **options):
    sim = Simulation(TaskConfig(**options), Fixed(np.asarray(value, dtype=float)))
    return sim.run(np.zeros((count, 8)), perturbed or [None] * count)


def goal_offset(start="index+thumb", goal="index+middle+thumb", name="bar"):
    return grasp(name)[GRIPS[goal]] - grasp(name)[GRIPS[start]]


# ---------------------------------------------------------------- bit for bit


@pytest.mark.parametrize("perturbed", [False, True], ids=["nominal", "perturbed"])
@pytest.mark.parametrize("state", ["joints", "joints+tactile"])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_batch_equals_plain_rollouts_bit_for_bit(controller, state, perturbed):
    sim = make(state, controller=controller)
    theta = parameters(sim.policy, 5)
    different = perturbations(5) if perturbed else [None] * 5
    rollouts = sim.run(theta, different)
    for i in range(5):
        assert_rows_equal(rollouts, i, plain_rollout(sim.task.config, sim.policy, theta[i], different[i]), 0)


def test_the_rollouts_compared_drop_and_hold():
    # The test above would say little if every rollout ended alike.
    for controller in CONTROLLERS:
        sim = make(controller=controller)
        steps = sim.run(parameters(sim.policy, 32), [None] * 32).outcome.steps
        assert 0 < (steps == 15).sum() < 32, controller


@pytest.mark.parametrize(
    "options",
    [
        {"start_grip": "index+middle+thumb", "goal_grip": "index+thumb"},
        {"state": "joints+contacts", "contacts_scale": 0.5, "joints_scale": 2.0},
        {"state": "tactile", "tactile_scale": 0.1, "reward": "basic", "weights": "direct"},
        {"steps": 22, "gamma": 0.9},
    ],
    ids=lambda options: "-".join(options),
)
def test_other_tasks_equal_plain_rollouts(options):
    config = TaskConfig(**options)
    policy = make_policy(state_size=SIZES[config.state])
    theta, different = parameters(policy, 4), [None, *perturbations(3, config.steps)]
    rollouts = Simulation(config, policy).run(theta, different)
    for i in range(4):
        assert_rows_equal(rollouts, i, plain_rollout(config, policy, theta[i], different[i]), 0)


@pytest.mark.parametrize(
    "options", [{"action": "absolute"}, {"action": "increment"}, {"clip": False}], ids=lambda o: str(*o.values())
)
def test_other_actions_equal_plain_rollouts(options):
    policy = make_policy("direct", **options)
    theta = parameters(policy, 4)
    rollouts = Simulation(TaskConfig(), policy).run(theta, [None] * 4)
    for i in range(4):
        assert_rows_equal(rollouts, i, plain_rollout(TaskConfig(), policy, theta[i], None), 0)


def test_many_features_equal_plain_rollouts():
    policy = make_policy(features=8000)
    theta = parameters(policy, 3)
    rollouts = Simulation(TaskConfig(), policy).run(theta, [None] * 3)
    for i in range(3):
        assert_rows_equal(rollouts, i, plain_rollout(TaskConfig(), policy, theta[i], None), 0)


def test_huge_unclipped_actions_equal_plain_rollouts():
    policy = make_policy("direct", clip=False)
    theta = parameters(policy, 4) * np.array([1e3, 1e9, 1e160, 1e307])[:, None]
    rollouts = Simulation(TaskConfig(), policy).run(theta, [None] * 4)
    for i in range(4):
        assert_rows_equal(rollouts, i, plain_rollout(TaskConfig(), policy, theta[i], None), 0)
    assert rollouts.outcome.clamped.tolist() == [False, True, True, True]
    assert np.isfinite(rollouts.outcome.returns).all()
    assert (rollouts.outcome.returns[1:] == -1e12).all()


MIXED = CAPACITY + 26
assert CAPACITY < MIXED * 4 // 5  # the perturbed ones alone are more than fit


@functools.cache
def mixed(state="joints+tactile"):
    """Return a simulation, rollouts of it, nominal and perturbed (some in pairs), and all run at once."""
    sim = make(state)
    theta = parameters(sim.policy, MIXED)
    drawn = perturbations(MIXED // 2)
    different = [None if i % 5 == 0 else drawn[i // 2] for i in range(MIXED)]
    return sim, theta, different, sim.run(theta, different)


def test_a_mixed_batch_beyond_the_capacity_equals_plain_rollouts():
    sim, theta, different, rollouts = mixed()
    for i in range(MIXED):
        assert_rows_equal(rollouts, i, plain_rollout(sim.task.config, sim.policy, theta[i], different[i]), 0)


@pytest.mark.parametrize("size", [1, 5, 32, CAPACITY])
def test_chunks_change_nothing(size):
    sim, theta, different, rollouts = mixed()
    for start in range(0, MIXED, size):
        part = sim.run(theta[start : start + size], different[start : start + size])
        for k in range(len(part.targets)):
            assert_rows_equal(part, k, rollouts, start + k)


@pytest.mark.parametrize("seed", [0, 1])
def test_order_changes_nothing(seed):
    sim, theta, different, rollouts = mixed()
    order = np.random.default_rng(seed).permutation(MIXED)
    again = sim.run(theta[order], [different[i] for i in order])
    for k, i in enumerate(order):
        assert_rows_equal(again, k, rollouts, i)


def test_threads_change_nothing():
    _, theta, different, rollouts = mixed()
    again = make("joints+tactile", threads=2).run(theta, different)
    for i in range(MIXED):
        assert_rows_equal(again, i, rollouts, i)


def test_memory_layout_changes_nothing():
    for controller in CONTROLLERS:
        sim = make(controller=controller)
        theta = parameters(sim.policy, 5)
        rollouts = sim.run(theta, [None] * 5)
        wide = np.zeros((10, 2 * sim.policy.size))
        wide[::2, ::2] = theta
        for other in (np.asfortranarray(theta), wide[::2, ::2], theta[::-1][::-1], theta.view(np.ndarray)):
            again = sim.run(other, [None] * 5)
            for i in range(5):
                assert_rows_equal(again, i, rollouts, i)


def test_equal_perturbations_of_other_identity_change_nothing():
    sim, theta, _, _ = mixed()
    shared = perturbations(1) * 3
    one, two = sim.run(theta[:3], shared), sim.run(theta[:3], [copy.deepcopy(p) for p in shared])
    for i in range(3):
        assert_rows_equal(one, i, two, i)


@pytest.mark.parametrize("perturbed", [False, True], ids=["nominal", "perturbed"])
def test_physics_rate_shows_more_of_the_same_rollouts(perturbed):
    sim, theta, different, rollouts = mixed()
    chosen = [i for i, p in enumerate(different) if (p is not None) == perturbed][:6]
    fine = sim.run(theta[chosen], [different[i] for i in chosen], substeps=1)
    assert fine.frames.qpos.shape == (len(chosen), 150, 15)
    for k, i in enumerate(chosen):
        every = {name: values[k : k + 1] for name, values in leaves(fine).items()}
        for name, values in leaves(rollouts).items():
            seen = every[name][:, SUBSTEPS - 1 :: SUBSTEPS] if name.startswith(".frames") else every[name]
            assert seen[0].tobytes() == values[i].tobytes(), name
        assert_rows_equal(fine, k, plain_rollout(sim.task.config, sim.policy, theta[i], different[i], 1), 0)


def test_a_single_rollout_keeps_its_leading_axis():
    sim, theta, different, rollouts = mixed()
    for i in (0, 1):
        one = sim.run(theta[i : i + 1], different[i : i + 1])
        assert all(len(values) == 1 for values in leaves(one).values())
        assert_rows_equal(one, 0, rollouts, i)


# ---------------------------------------------------------------- ends


def test_what_follows_an_end_is_zero():
    sim = make("joints+tactile")
    rollouts = sim.run(parameters(sim.policy, 20), [None] * 20)
    steps = rollouts.outcome.steps
    assert steps.min() < 15
    for i in np.flatnonzero(steps < 15):
        n = steps[i]
        assert rollouts.outcome.dropped[i]
        assert not rollouts.outcome.success[i]
        assert not rollouts.frames.force[i, n - 1].any()
        assert touching(rollouts.frames.force[i, : n - 1]).all()
        for name, values in leaves(rollouts).items():
            if values.ndim > 1 and not name.startswith(".start"):
                assert not values[i, n:].any(), name
        assert rollouts.outcome.terms[i, n - 1, 4] == -WEIGHTS["projected"].drop
        assert np.count_nonzero(rollouts.outcome.terms[i, :, 4]) == 1


def poison(monkeypatch, row, control_step, value):
    """Put a value into one simulation's state at the end of a control step of the rollout."""
    step, count = Stepper.step, {"released": 0}

    def poisoned(self, ids, nstep):
        step(self, ids, nstep)
        if nstep == SUBSTEPS:
            if count["released"] == control_step and row in ids:
                self.batch.bind("qvel")[row, 3] = value
            count["released"] += 1

    monkeypatch.setattr(Stepper, "step", poisoned)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e200, 1e9])
@pytest.mark.parametrize("control_step", [0, 4, 14])
def test_a_rollout_that_blows_up_is_failed_and_disturbs_nobody(monkeypatch, control_step, value):
    sim = Simulation(TaskConfig(), Fixed(goal_offset()))
    healthy = sim.run(np.zeros((4, 8)), [None] * 4)
    with monkeypatch.context() as patch:
        poison(patch, 2, control_step, value)
        rollouts = sim.run(np.zeros((4, 8)), [None] * 4)
    outcome = rollouts.outcome
    assert outcome.failed.tolist() == [False, False, True, False]
    assert not outcome.dropped.any()
    assert outcome.success.tolist() == [True, True, False, True]
    assert outcome.steps.tolist() == [15, 15, control_step + 1, 15]
    rewards = healthy.outcome.terms[2].sum(axis=-1)[:control_step]
    expected = 0.1 * (sum(0.95**t * r for t, r in enumerate(rewards)) - 0.95**control_step * 400.0)
    assert outcome.returns[2] == pytest.approx(expected, rel=1e-12)
    assert outcome.terms[2, control_step].tolist() == [0, 0, 0, 0, -400.0]
    assert all(np.isfinite(values).all() for values in leaves(rollouts).values())
    for i in (0, 1, 3):
        assert_rows_equal(rollouts, i, healthy, i)
    again = sim.run(np.zeros((4, 8)), [None] * 4)
    for i in range(4):
        assert_rows_equal(again, i, healthy, i)


def test_physics_that_explodes_by_itself_is_failed(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # the simulator keeps a log of its warnings
    sim = Simulation(TaskConfig(), Fixed(goal_offset()))
    different = [*perturbations(2), None]
    healthy = sim.run(np.zeros((3, 8)), different)
    run = Simulation.begin

    def begin(self, *arguments):
        stepper, start, noise = run(self, *arguments)
        if noise is not None:
            stepper.batch.bind("qvel")[1] = 1e7  # well below the limit at first
        return stepper, start, noise

    with monkeypatch.context() as patch:
        patch.setattr(Simulation, "begin", begin)
        rollouts = sim.run(np.zeros((3, 8)), different)
    assert rollouts.outcome.failed.tolist() == [False, True, False]
    assert rollouts.outcome.returns[1] == pytest.approx(-40.0)
    assert all(np.isfinite(values).all() for values in leaves(rollouts).values())
    for again in (rollouts, sim.run(np.zeros((3, 8)), different)):
        for i in (0, 2):
            assert_rows_equal(again, i, healthy, i)


# ---------------------------------------------------------------- what the task is worth


def test_holding_still_earns_little():
    outcome = fixed(np.zeros(8)).outcome
    assert outcome.returns[0] == pytest.approx(-5.4, abs=1.0)
    assert not outcome.success[0]
    assert outcome.steps[0] == 15


def test_the_demonstration_at_once_is_nearly_perfect():
    outcome = fixed(goal_offset()).outcome
    assert -0.3 < outcome.returns[0] < 0
    assert outcome.success[0]


def test_dropping_at_once_costs_the_penalty():
    outcome = fixed(np.full(8, -2.0)).outcome
    assert outcome.steps[0] <= 2
    assert outcome.dropped[0]
    assert outcome.returns[0] == pytest.approx(-42.0, abs=4.0)


@pytest.mark.parametrize("grip", ["index+thumb", "index+middle+thumb"])
def test_a_grip_holds_for_three_seconds_by_itself(grip):
    sim = Simulation(TaskConfig(start_grip=grip, goal_grip=grip, steps=30), Fixed(np.zeros(8)))
    rollouts = sim.run(np.zeros((1, 8)), [None], substeps=1)
    shift, turn = moved(rollouts.frames.pose[0], rollouts.start.pose)
    assert shift.max() < 0.005
    assert np.rad2deg(turn.max()) < 15.0
    press = rollouts.frames.force[0].sum(axis=-1)
    for f, finger in enumerate(FINGERS):
        if finger in GRIPS[grip]:
            assert press[:, f].min() > PRESSES, finger
        else:
            assert not press[:, f].any(), finger
    assert rollouts.outcome.success[0]


def test_the_demonstrated_grip_succeeds_when_perturbed():
    rollouts = fixed(goal_offset(), 100, perturbations(100))
    assert rollouts.outcome.success.sum() >= 95


def test_the_start_grip_alone_is_no_success_when_perturbed():
    outcome = fixed(np.zeros(8), 100, perturbations(100)).outcome
    assert not outcome.success.any()
    assert (outcome.steps == 15).sum() >= 95


def test_perturbations_reach_the_physics():
    base = Perturbation(1.0, 1.0, np.zeros(3), np.zeros((15, 8)))
    others = [
        dataclasses.replace(base, friction=0.8),
        dataclasses.replace(base, mass=1.2),
        dataclasses.replace(base, displacement=np.array([0.0, 0.002, 0.0])),
        base,
    ]
    rollouts = fixed(goal_offset(), 5, [None, *others])
    for i in (1, 2, 3):
        assert (rollouts.frames.qpos[i] != rollouts.frames.qpos[0]).any()
    assert_rows_equal(rollouts, 4, rollouts, 0)  # one that changes nothing changes nothing
    assert rollouts.start.pose[3, 1] - rollouts.start.pose[0, 1] == pytest.approx(0.002, abs=5e-4)


def test_noise_is_seen_by_the_controller_only():
    noisy = Perturbation(1.0, 1.0, np.zeros(3), np.full((15, 8), 0.1))
    still = fixed(goal_offset(), 2, [None, noisy])
    assert_rows_equal(still, 0, still, 1)
    sim = make()
    theta = np.repeat(parameters(sim.policy, 1), 2, axis=0)
    rollouts = sim.run(theta, [None, noisy])
    x = rollouts.start.joints + np.array([[0.0], [0.1]])
    expected = sim.policy.actions(sim.policy.weights(theta), x)
    np.testing.assert_array_equal(rollouts.actions[:, 0], expected)


# ---------------------------------------------------------------- grips are found, not typed in


BODY = """<mujoco model="thing"><worldbody>
  <body name="object" pos="{place}"><freejoint name="object"/>{geom}</body>
</worldbody></mujoco>"""
GEOM = '<geom name="thing" {kind} mass="{mass}" contype="2" conaffinity="1" condim="4" friction="1 0.01 0.001"/>'


@pytest.fixture
def thing(monkeypatch, tmp_path):
    """Make an object file that the scene finds under the name `thing`."""
    real, known = assets.path, assets.objects()

    def make_thing(kind, place="0.08 0.04 0.02", mass=0.05):
        (tmp_path / "thing.xml").write_text(BODY.format(place=place, geom=GEOM.format(kind=kind, mass=mass)))
        monkeypatch.setattr(assets, "objects", lambda: [*known, "thing"])
        monkeypatch.setattr(assets, "path", lambda n: tmp_path / "thing.xml" if n == "objects/thing.xml" else real(n))
        return "thing"

    return make_thing


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ('type="box" size="0.008 0.06 0.008"', "0.08 0.04 0.02"),
        ('type="box" size="0.014 0.06 0.014"', "0.08 0.04 0.02"),
        ('type="box" size="0.011 0.06 0.011"', "0.08 0.04 0.025"),
        ('type="box" size="0.011 0.06 0.011"', "0.076 0.038 0.018"),
    ],
    ids=["thin", "thick", "higher", "nearer"],
)
def test_a_grip_is_found_for_another_bar(thing, kind, place):
    name = thing(kind, place)
    scene = scenes.load(name)
    grasping = Grasping(scene)
    for finger in FINGERS:
        gap = contact_gap(scene, grasping.contact, finger)
        assert 0 <= gap < 1e-6, finger
    assert np.abs(grasping.contact - Grasping(scene_of("bar")).contact).max() > 0.01
    fingers = GRIPS["index+middle+thumb"]
    offset = grasping.command(fingers) - grasping.command(GRIPS["index+thumb"])
    outcome = fixed(offset, object=name).outcome
    assert outcome.success[0]


def contact_gap(scene, joints, finger):
    data = mujoco.MjData(scene.model)
    data.qpos[:8] = joints
    mujoco.mj_kinematics(scene.model, data)
    tip, (geom,) = scene.model.geom(f"{finger}_tip").id, scene.object_geoms
    return mujoco.mj_geomDistance(scene.model, data, tip, geom, 1.0, None)


def test_waiting_fingers_keep_their_distance():
    scene = scene_of("bar")
    waiting = Grasping(scene).command(())
    for finger in FINGERS:
        assert contact_gap(scene, waiting, finger) == pytest.approx(0.02, abs=2e-3)


def test_an_object_in_the_way_is_a_clear_error(thing):
    name = thing('type="sphere" size="0.08"')
    with pytest.raises(ConfigError, match=r"'thing' is in the way of the \w+ finger"):
        Grasping(scenes.load(name))


def test_a_goal_grip_that_does_not_hold_is_a_clear_error(thing):
    name = thing('type="box" size="0.011 0.06 0.011"', mass=5.0)
    with pytest.raises(ConfigError, match="'index\\+thumb' does not hold object 'thing'"):
        Simulation(TaskConfig(object=name, goal_grip="index+thumb"), Fixed(np.zeros(8)))


def test_a_start_grip_that_does_not_hold_is_a_clear_error():
    with pytest.raises(ConfigError, match="'middle\\+thumb' does not hold object 'bar'"):
        Simulation(TaskConfig(start_grip="middle+thumb"), Fixed(np.zeros(8)))


def test_a_command_does_not_depend_on_what_was_asked_before():
    grasping = Grasping(scene_of("bar"))
    fresh = {fingers: copy.deepcopy(grasping.data) for fingers in ((), *GRIPS.values())}
    commands = {}
    for fingers, data in fresh.items():
        grasping.data = data
        commands[fingers] = grasping.command(fingers)
    for first in commands:
        for fingers in commands:
            grasping.command(first)
            assert grasping.command(fingers).tobytes() == commands[fingers].tobytes()


def test_a_finger_that_grips_commands_the_same_in_every_grip():
    commands = grasp("bar")
    three = commands[GRIPS["index+middle+thumb"]]
    for fingers in GRIPS.values():
        for finger in FINGERS:
            joints = list(FINGER_JOINTS[finger])
            same = three if finger in fingers else commands[()]
            np.testing.assert_array_equal(commands[fingers][joints], same[joints])


def test_an_unknown_object_is_a_clear_error():
    with pytest.raises(ConfigError, match="unknown object 'spoon'; known are .*bar"):
        Simulation(TaskConfig(object="spoon"), Fixed(np.zeros(8)))
