"""The closed loop on small test tasks: independent rows, ends, failures, and clear errors."""

import mujoco
import numpy as np
import pytest
from carts import XML, Pole, arrays, new_runner, same, thetas

from farm.errors import ConfigError, TaskError
from farm.net.work import Jobs
from farm.returns import RETURN_FLOOR
from farm.runner import Runner
from farm.sim.engines import CAPACITY
from farm.tasks.base import Channel, Record, Score, Task
from farm.tasks.rollouts import discounted, trajectory

SEEDS = [None, (1, 2, 3, 4), (1, 2, 3, 4), (5, 0, 0, 0), None, (9, 9, 9, 9), (5, 0, 0, 0)]


def test_a_rollout_does_not_depend_on_its_batch():
    runner = new_runner()
    theta = thetas(runner, 7, 4.0)
    together = runner.rollouts(theta, SEEDS)
    assert len(set(together.steps.tolist())) > 2, "some end early"
    order = [3, 6, 0, 5, 1, 4, 2]
    permuted = runner.rollouts(theta[order], [SEEDS[i] for i in order])
    for at, row in enumerate(order):
        same(together, row, permuted, at)
        same(together, row, runner.rollouts(theta[row : row + 1], [SEEDS[row]]), 0)
    fresh = new_runner().rollouts(theta[::-1], SEEDS[::-1])
    for row in range(7):
        same(together, row, fresh, 6 - row)


class Changed(Pole):
    """A task whose rollouts have models of their own: what a reset takes from the model among
    them.
    """

    def prepare(self, sim, rngs):
        """Draw masses and a pose that a reset begins at, and read an output in between."""
        masses, pose = sim.expand("body_mass"), sim.expand("qpos0")
        for row, rng in enumerate(rngs):
            sim.qpos[row, 0] += 0.0 if rng is None else 0.1 * sim.xpos[row, 1, 2]
            if rng is not None:
                masses[row, 2] *= rng.uniform(0.5, 2.0)
                pose[row, 1] += rng.uniform(-0.3, 0.3)
        sim.own["goal"] = np.zeros(len(rngs))

    def observe(self, sim):
        """It sees its mass."""
        return np.concatenate([sim.qpos, sim.qvel, sim.expand("body_mass")[:, 2:]], axis=1)


def test_models_of_rollouts_do_not_leak_into_later_ones():
    runner = new_runner(Changed, width=0.2)
    theta = thetas(runner, len(SEEDS), 3.0)
    first = runner.rollouts(theta, SEEDS)
    assert 0 < first.ended.sum() < len(SEEDS)
    again = runner.rollouts(theta, SEEDS)
    for row in reversed(range(len(SEEDS))):
        same(first, row, again, row)
        for other in (runner, new_runner(Changed, width=0.2)):
            same(first, row, other.rollouts(theta[row : row + 1], [SEEDS[row]]), 0)


def test_more_rollouts_than_the_engine_has_rows_are_done_in_turns():
    runner = new_runner()
    count = runner.sim.engine.size + 9
    theta, seeds = thetas(runner, count), [(0, 0, 0, i // 2) for i in range(count)]
    together = runner.rollouts(theta, seeds)
    for row in (0, 40, count - 10, count - 1):
        same(together, row, runner.rollouts(theta[row : row + 1], [seeds[row]]), 0)


def test_physics_rate_shows_more_of_the_same():
    runner = new_runner()
    theta = thetas(runner, 3, 4.0)
    coarse = runner.rollouts(theta, SEEDS[:3])
    fine = runner.rollouts(theta, SEEDS[:3], physics=True)
    assert fine.frames["angle"].shape == (3, 48, 1)
    assert fine.frames["angle"][:, 3::4].tobytes() == coarse.frames["angle"].tobytes()
    assert fine.returns.tobytes() == coarse.returns.tobytes()


def test_it_is_a_plain_loop():
    runner = new_runner(steps=5)
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    data.qpos[1] = 0.05
    mujoco.mj_forward(model, data)
    theta, value = thetas(runner, 1), 0.0
    prepared = runner.policy.prepare(theta)
    for _ in range(5):
        x = np.concatenate([data.sensordata, data.qvel, data.qpos[:1]])[None]
        data.ctrl[:] = -3 + 8 * 0.5 * (1 + np.clip(runner.policy.act(prepared, x)[0], -1, 1))
        for _ in range(4):
            mujoco.mj_step(model, data)
        value += float(np.cos(data.qpos[1]) - abs(data.qpos[0]))
    assert runner.rollouts(theta, [None]).returns[0] == pytest.approx(value, rel=1e-14)


def test_ends_and_success():
    runner = new_runner()
    rollouts = runner.rollouts(thetas(runner, 7, 4.0), SEEDS)
    for row in range(7):
        angle, steps = rollouts.frames["qpos"][row, :, 1], rollouts.steps[row]
        assert rollouts.ended[row] == bool(np.abs(angle).max() > 0.6)
        assert not angle[steps:].any()
        assert not rollouts.terms[row, steps:].any()
        assert rollouts.success[row] == (abs(angle[steps - 1]) < 0.3)
        assert rollouts.returns[row] == pytest.approx(rollouts.terms[row].sum())
    never = runner.task.Config(width=100.0)
    assert not new_runner(width=never.width).rollouts(thetas(runner, 7), SEEDS).ended.any()


def test_a_trajectory_has_the_channels():
    runner = new_runner()
    rollouts = runner.rollouts(thetas(runner, 1), [None])
    motion = trajectory(runner.task, runner.spec, runner.scene, rollouts, 0)
    assert {name: v.shape[1:] for name, v in motion.arrays().items()} == runner.spec.shapes(
        len(runner.scene.bodies)
    )
    assert motion.channels["angle"][0, 0] == pytest.approx(0.05)
    assert motion.times[-1] == pytest.approx(rollouts.steps[0] * 0.04)
    assert motion.success in (True, False)


class Fragile(Pole):
    """Blows up where it is asked to."""

    def reset(self, sim, row, rng):
        """Throw one of them away."""
        if rng is not None:
            sim.qvel[row, 0] = 1e9

    def ended(self, sim):
        """Never."""


class Compiled(Fragile):
    """The same, compiled by itself."""

    def compiled(self):
        """MuJoCo would begin again where it blows up."""
        return mujoco.MjModel.from_xml_string(self.mjcf())


@pytest.mark.parametrize("kind", [Fragile, Compiled])
def test_a_rollout_that_blows_up_fails_alone(kind):
    runner = new_runner(kind)
    theta = thetas(runner, 3)
    rollouts = runner.rollouts(theta, [None, (1, 1, 1, 1), None])
    assert rollouts.failed.tolist() == [False, True, False]
    assert rollouts.returns[1] == RETURN_FLOOR
    assert rollouts.clamped.tolist() == [False, True, False]
    assert all(np.isfinite(values).all() for values in arrays(rollouts).values())
    same(rollouts, 2, runner.rollouts(theta[2:], [None]), 0)


def broken(**methods) -> Runner:
    return new_runner(type("Broken", (Pole,), methods))


@pytest.mark.parametrize(
    ("methods", "line"),
    [
        (
            {"reward": lambda _, sim, a: np.zeros((len(sim), 2))},
            r"reward gave an array of shape \(1, 2\); expected an " r"array of shape \(1,\)",
        ),
        ({"reward": lambda _, sim, a: 1.0}, "reward reward gave a float"),
        (
            {"reward": lambda _, sim, a: {"near": np.full(len(sim), np.nan)}},
            "reward 'near' is not finite in control step 1, though the physics is fine",
        ),
        (
            {"act": lambda _, sim, a: np.zeros((len(sim), 3))},
            r"act gave an array of shape \(1, 3\); expected an array " r"of shape \(1, 1\)",
        ),
        ({"observe": lambda _, sim: [1.0]}, "observe gave a list"),
        ({"ended": lambda _, sim: np.zeros(2, dtype=bool)}, r"ended gave an array of shape \(2,\)"),
        (
            {"measure": lambda _, sim: {"angle": np.zeros(3)}},
            r"angle gave an array of shape \(3,\)",
        ),
        ({"measure": lambda _, sim: [sim.qpos]}, "measure gave a list; expected arrays by name"),
        (
            {"measure": lambda _, sim: {"height": sim.qpos}},
            "channel 'angle' is not measured: measure gives qpos, height",
        ),
        (
            {"measure": lambda _, sim: {"angle": sim.qpos}},
            r"channel 'angle' gave an array of shape \(1, 1, 2\)",
        ),
        (
            {"observe": lambda _, sim: sim.qpos[:, 0]},
            r"observe gave an array of shape \(1,\); expected an array of " r"shape \(1, 1\)",
        ),
        (
            {"observe": lambda _, sim: np.full((len(sim), 2), "x")},
            "observe gave an array of <U1; expected real",
        ),
        (
            {"observe": lambda _, sim: sim.qpos * np.nan},
            "observe is not finite before control step 1, though",
        ),
        ({"reward": lambda _, sim, a: {}}, "reward gave no terms"),
        (
            {"reward": lambda _, sim, a: {1: sim.qpos[:, 0]}},
            "reward names a term 1; expected texts as names",
        ),
        (
            {"prepare": lambda _, sim, rngs: sim.expand("geom_fricton")},
            "MuJoCo's model has no field 'geom_fricton'",
        ),
        (
            {"prepare": lambda _, sim, rngs: sim.own.update(goal=3)},
            r"sim.own\['goal'\] is a int; expected an array of",
        ),
        (
            {"steps": 1, "success": lambda _, sim: np.ones(2)},
            r"success gave an array of shape \(2,\)",
        ),
    ],
)
def test_arrays_that_make_no_sense_are_named(methods, line):
    with pytest.raises(TaskError, match=line):
        broken(**methods)


def test_an_observation_that_is_not_finite_later_is_a_failure():
    runner = broken(observe=lambda _, sim: sim.qpos / (1.0 if sim.t < 2 else np.zeros(1)))
    with np.errstate(all="ignore"):
        assert runner.rollouts(np.zeros((2, runner.size)), [None, None]).failed.all()
    assert str(runner.trouble.errors[0]).startswith(
        "observe is not finite before control step 3, though"
    )


@pytest.mark.parametrize("what", ["ended", "success"])
def test_what_is_decided_by_a_number_that_is_not_finite_is_a_failure(what):
    def decided(_, sim):
        return np.where(sim.nominal, 0.0, np.nan)

    runner = broken(**{what: decided, "steps": 1})
    rollouts = runner.rollouts(np.zeros((7, runner.size)), SEEDS)
    assert rollouts.failed.tolist() == [seed is not None for seed in SEEDS]
    assert not rollouts.ended.any()
    assert not rollouts.success[rollouts.failed].any()
    assert str(runner.trouble.errors[0]).startswith(f"{what} is not finite in control step 1")


def test_success_says_nothing_of_rollouts_that_go_on():
    def success(_, sim):
        return np.where(np.abs(sim.qpos[:, 1]) > 0.6, 1.0, np.nan)

    runner = broken(success=success, steps=8)
    theta = thetas(runner, 7, 4.0)
    together = runner.rollouts(theta, SEEDS)
    assert 0 < together.ended.sum() < 7
    for row in range(7):
        same(together, row, runner.rollouts(theta[row : row + 1], [SEEDS[row]]), 0)
    assert (together.failed == ~together.ended).all(), "at the end it is asked of all"


def change_of(field):
    """Changes of a field's first number in each step, and a reward that notes them."""
    changes = []

    def reward(_, sim, action):
        now = getattr(sim, field)
        changes.append(now[:, 0] - sim.own.get("last", 0.0 * now)[:, 0])
        sim.own["last"] = now
        return changes[-1]

    return changes, reward


def test_controls_that_are_kept_are_those_of_the_step():
    changes, reward = change_of("ctrl")
    runner = broken(
        reward=reward, act=lambda _, sim, action: np.full((len(sim), 1), 0.1 * (1 + sim.t))
    )
    runner.rollouts(np.zeros((1, runner.size)), [None])
    assert [float(each[0]) for each in changes[-5:]] == pytest.approx([0.1] * 5)


def test_what_is_kept_of_the_simulation_is_what_it_was():
    moved, reward = change_of("qpos")

    def reset(_, sim, row, rng):
        sim.qvel[row, 0] = 1.0
        sim.own["begun"] = sim.qpos

    runner = broken(
        reward=reward,
        reset=reset,
        measure=lambda _, sim: {"begun": sim.own["begun"]},
        channels=(),
        ended=lambda _, sim: None,
    )
    rollouts = runner.rollouts(np.zeros((1, runner.size)), [None])
    assert min(float(each[0]) for each in moved[-12:]) > 0.01, "as it moves on"
    assert not rollouts.frames["begun"].any()


def test_options_of_each_rollouts_own_that_are_one_number():
    def reset(_, sim, row, rng):
        sim.expand("opt.density")[row] = 0.0 if rng is None else 50.0
        sim.qvel[row, 0] = 1.0

    runner = broken(reset=reset, ended=lambda _, sim: None)
    far = runner.rollouts(np.zeros((2, runner.size)), [None, (1,)]).frames["qpos"][:, -1, 0]
    assert far[0] > far[1] > 0.0


def test_a_policy_gives_as_many_numbers_as_the_task_takes():
    runner = broken(actions=2, act=lambda _, sim, action: action[:, :1])
    wide = runner.policy.act
    runner.policy.act = lambda theta, x: wide(theta, x)[:, :1]
    with pytest.raises(TaskError, match=r"act of the policy gave an array of shape \(1, 1\)"):
        runner.rollouts(np.zeros((1, runner.size)), [None])


@pytest.mark.parametrize(
    ("attributes", "line"),
    [
        ({"steps": 0}, "task Broken: steps is 0; expected a whole number from 1 to 10000"),
        ({"substeps": 1.0}, "task Broken: substeps is 1.0"),
        ({"ending": "fell over"}, "task Broken: ending is 'fell over'; expected one word"),
        ({"ending": 3}, "task Broken: ending is 3; expected one word"),
        ({"parts": (1, 5)}, r"parts are \(1, 5\); expected sizes that add up to the obs"),
        ({"parts": 2}, "task Broken: parts is 2; expected a tuple of sizes"),
        ({"camera": (0, 0, 0)}, "task Broken: camera is .*; expected a farm.Camera"),
        ({"channels": [1]}, r"task Broken: channels is \[1\]; expected a tuple of farm.Channel"),
        ({"channels": None}, "task Broken: channels is None"),
        (
            {"channels": (Channel(name="angle", kind="scalars", shape=(1,), geoms=("hand",)),)},
            "task Broken: there is no geometry 'hand' in the model, which channel 'angle' names",
        ),
        (
            {"channels": (Channel(name="push", kind="arrows", shape=(1, 6), bodies=("hand",)),)},
            "task Broken: there is no body 'hand' in the model, which channel 'push' names",
        ),
        (
            {"reset": lambda _, row, rng: None},
            r"reset\(_, row, rng\); expected \(self, sim, row, rng\)",
        ),
        ({"reward": Task.reward}, "task Broken has no reward: give it"),
        (
            {"xml": XML.replace('<motor joint="slide" ctrlrange="-3 5"/>', "")},
            "its model has no actuator",
        ),
    ],
)
def test_classes_that_make_no_sense_are_named(attributes, line):
    with pytest.raises(ConfigError, match=line):
        broken(**attributes)


def test_an_observation_keeps_its_length():
    runner = broken(observe=lambda _, sim: np.zeros((len(sim), 2 + sim.t // 3)))
    with pytest.raises(TaskError, match=r"shape \(1, 3\); expected an array of shape \(1, 2\)"):
        runner.rollouts(thetas(runner, 1), [None])


def test_names_that_sim_does_not_have_are_named():
    with pytest.raises(AttributeError, match=r"sim.qpos is written in place"):
        broken(reset=lambda _, sim, row, rng: setattr(sim, "qpos", np.zeros((1, 2))))
    with pytest.raises(AttributeError, match="sim has no 'qpso'"):
        broken(observe=lambda _, sim: sim.qpso)


def test_a_model_that_mujoco_refuses_is_one_line():
    with pytest.raises(ConfigError, match="Broken: MuJoCo refuses the model: .*"):
        broken(xml="<mujoco><body/>")
    with pytest.raises(ConfigError, match="task Broken has no model: give it `xml`"):
        broken(xml="")
    with pytest.raises(ConfigError, match="xml is a bytes; expected a text or a path of a model"):
        broken(xml=b"<mujoco/>")


def test_a_score_that_is_none_is_named():
    runner = broken(score=lambda _, record: 3)
    with pytest.raises(TaskError, match="score gave a int; expected a farm.Score, or None"):
        runner.rollouts(thetas(runner, 1), [None])


def test_a_batch_says_when_it_is_done():
    runner = broken()
    counts = list[int]()
    jobs = Jobs.mean("none", [(0, 0, 0, start) for start in range(CAPACITY + 8)])
    runner.run(np.zeros(runner.size), jobs, advance=counts.append)
    assert counts == [CAPACITY, 8]


class Whole(Pole):
    """Scores whole rollouts."""

    def score(self, record: Record) -> Score:
        """The same as step by step, with no success."""
        qpos = record.frames["qpos"]
        inside = np.arange(self.steps) < record.steps[:, None]
        return Score(np.where(inside, np.cos(qpos[..., 1]), 0.0)[..., None])


def test_whole_rollouts_can_be_scored_at_once():
    whole, step = new_runner(Whole), new_runner()
    theta = thetas(whole, 7, 4.0)
    once, each = whole.rollouts(theta, SEEDS), step.rollouts(theta, SEEDS)
    np.testing.assert_allclose(once.terms[..., 0], each.terms[..., 0], rtol=1e-15)
    assert not whole.spec.success
    assert whole.spec.terms == ("reward",)


def test_the_return_is_discounted_and_never_looks_good_when_it_overflows():
    terms = np.random.default_rng(0).normal(size=(4, 15, 3))
    expected = [
        0.5 * sum(0.9**t * step.sum() for t, step in enumerate(rollout)) for rollout in terms
    ]
    np.testing.assert_allclose(discounted(terms, 0.9, 0.5)[0], expected, rtol=1e-12)
    for bad in (np.nan, -np.inf, np.inf, -1e13):
        terms[1, 3, 0] = bad
        returns, clamped = discounted(terms, 0.9, 1.0)
        assert clamped.tolist() == [False, True, False, False]
        assert returns[1] == RETURN_FLOOR


def test_sim_shows_what_is_going_and_follows_it():
    runner = new_runner()
    sim = runner.sim
    sim.begin(3)
    sim.qpos[:, 0] = (1.0, 2.0, 3.0)
    sim.own["name"] = np.array([10, 20, 30])
    sim.start(np.array([0, 2, 2, 1]))
    assert sim.qpos[:, 0].tolist() == [1.0, 3.0, 3.0, 2.0]
    sim.keep(np.array([True, False, True, True]))
    assert (sim.qpos[:, 0].tolist(), sim.own["name"].tolist(), len(sim)) == (
        [1.0, 3.0, 2.0],
        [10, 30, 20],
        3,
    )
    sim.step(2)
    assert sim.qvel.shape == (3, 2)


def test_a_policy_of_another_shape_is_named():
    runner = new_runner()
    runner.policy.act = lambda prepared, x: np.zeros(len(x))
    with pytest.raises(TaskError, match=r"act of the policy gave an array of shape \(2,\)"):
        runner.rollouts(thetas(runner, 2), [None, None])
