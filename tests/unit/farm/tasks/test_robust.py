"""`farm.Robust` in rollouts: each cause does what it says, from the seed alone, and nothing at the
nominal start.
"""

import mujoco
import numpy as np
import pytest
from carts import XML, Pole, arrays, new_runner, same, thetas

import farm
from farm import seeds
from farm.errors import ConfigError, TaskError
from farm.policies.networks import Linear, LinearConfig
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks import loop
from farm.tasks.gymnasium import Environment
from farm.tasks.loop import Batch, Kept, again
from farm.tasks.probe import specification

SEEDS = [None, (1, 2, 3, 4), (1, 2, 3, 4), (5, 0, 0, 0), None, (9, 9, 9, 9), (5, 0, 0, 0)]
ALL = farm.Robust(
    noise=(0.01, 0.02, 0.03, 0.04),
    bias=0.05,
    observation_delay=(0.0, 0.15),
    action_delay=(0.0, 0.1),
    motors=(0.8, 1.2),
    mass=(0.7, 1.3),
    payload=(0.0, 0.5),
    friction=(0.5, 1.5),
    push=(1.0, 3.0),
    push_duration=0.08,
)


class Disturbed(Pole):
    """A pole with everything."""

    robust = ALL


def test_a_disturbed_rollout_does_not_depend_on_its_batch_and_pairs_share_conditions():
    runner = new_runner(Disturbed, width=0.3)
    theta = thetas(runner, 7, 4.0)
    together = runner.rollouts(theta, SEEDS)
    assert len(set(together.steps.tolist())) > 2, "some end early"
    order = [3, 6, 0, 5, 1, 4, 2]
    permuted = runner.rollouts(theta[order], [SEEDS[i] for i in order])
    for at, row in enumerate(order):
        same(together, row, permuted, at)
        same(
            together,
            row,
            new_runner(Disturbed, width=0.3).rollouts(theta[row : row + 1], [SEEDS[row]]),
            0,
        )
    conditions = together.start["robust/conditions"]
    assert np.array_equal(conditions[1], conditions[2])
    assert len(set(conditions[:, 0].tolist())) == 4, "three seeds, and the nominal start"


def test_nominal_rollouts_and_those_at_strength_0_are_those_of_a_task_without():
    plain = new_runner(width=0.3)
    theta = thetas(plain, 7, 4.0)
    without = arrays(plain.rollouts(theta, SEEDS))
    disturbed = arrays(new_runner(Disturbed, width=0.3).rollouts(theta, SEEDS))
    for name, values in without.items():
        assert values[[0, 4]].tobytes() == disturbed[name][[0, 4]].tobytes(), name
    assert without["returns"][1] != disturbed["returns"][1]
    off = arrays(new_runner(Disturbed, width=0.3, robust=0.0).rollouts(theta, SEEDS))
    assert off.keys() == without.keys()
    assert all(off[name].tobytes() == values.tobytes() for name, values in without.items())


def test_the_task_draws_what_it_drew_before():
    theta = thetas(new_runner(), 7)
    one, other = (new_runner(kind).rollouts(theta, SEEDS) for kind in (Pole, Disturbed))
    assert one.start["qpos"].tobytes() == other.start["qpos"].tobytes()


class Free(farm.Task):
    """Two bodies without gravity: a ball that a motor, a servo and a muscle move, and a block that
    is pushed.
    """

    xml = """<mujoco>
      <option timestep="0.01" gravity="0 0 0"/>
      <worldbody>
        <body name="ball">
          <joint name="x" type="slide" axis="1 0 0" range="-9 9"/>
          <geom name="ball" size="0.1" mass="2"/>
        </body>
        <body name="block" pos="0 0 5">
          <freejoint/>
          <geom type="box" size="0.1 0.1 0.1" mass="4"/>
        </body>
      </worldbody>
      <actuator>
        <motor name="motor" joint="x" ctrlrange="-9 9" forcerange="-3 3"/>
        <position name="servo" joint="x" kp="20" kv="3" ctrlrange="-1 1"/>
        <muscle name="muscle" joint="x" ctrlrange="0 1" force="10" lengthrange="-9 9"/>
        <muscle name="scaled" joint="x" ctrlrange="0 1" scale="5" lengthrange="-9 9"/>
      </actuator>
    </mujoco>"""
    steps, substeps = 20, 5  # 0.05 s each

    def reset(self, sim, row, rng):
        """It has an angle of its own."""
        sim.qpos[row, 0] = 0.2
        sim.qvel[row, 0] = -0.3

    def act(self, sim, action):
        """The actuators' controls, as they are."""
        return np.array(action)

    def observe(self, sim):
        """The time, and the ball's place."""
        return np.stack([np.full(len(sim), float(sim.t)), sim.qpos[:, 0]], axis=1)

    def reward(self, sim, action):
        """None."""
        return np.zeros(len(sim))


def batch_of(
    kind,
    conditions=None,
    seeds=((1, 2, 3, 4), None, (5, 0, 0, 0), (6, 0, 0, 0)),
    read=(),
    **settings,
):
    task = task_with(conditions, kind, **settings)
    specification(task)
    sim = Sim(task.engine(BatchEngine))

    def begun():
        batch = Batch(task, sim, seeds)
        for name in read:
            getattr(sim, name)
        return batch

    return again(begun)


def acted(batch, controls):
    """Observations (T, B, d) under constant controls."""
    seen = []
    while not batch.over:
        seen.append(batch.observe().copy())
        batch.step(np.tile(np.asarray(controls, dtype=float), (len(batch.active), 1)))
    return np.array(seen)


@pytest.mark.parametrize(
    "controls", [(2.0, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0), (8.0, 0, 0, 0)]
)
def test_a_motor_a_servo_and_a_muscle_have_the_same_part_of_their_force(controls):
    which = int(np.flatnonzero(controls)[0])
    forces = []
    for conditions in (None, farm.Robust(motors=(0.5, 0.9))):
        forces.append(first_force(Free, conditions, controls)[:, which])
    factors = forces[1] / forces[0]
    assert factors[1] == 1.0, "nominal"
    assert ((factors[[0, 2, 3]] > 0.5) & (factors[[0, 2, 3]] < 0.9)).all()
    assert len(set(factors.tolist())) == 4
    low, high = farm.Robust(motors=(0.5, 0.9)).motors
    sim = Sim(BatchEngine(Free().model, 4))
    sim.begin(4, None, [(1, 2, 3, 4), None, (5, 0, 0, 0), (6, 0, 0, 0)])
    part = 0.5 * (sim.noise(4, "farm.Robust motors", "uniform") + 1.0)
    assert np.allclose(
        factors[[0, 2, 3]], (low + (high - low) * part)[[0, 2, 3], which], rtol=1e-12
    )


def first_force(kind, conditions, controls):
    """Forces of actuators (B, nu) in the very first physics step, with activations of 1."""
    batch = batch_of(kind, conditions, read=["actuator_force"])
    with batch.sim.writing() as states:
        batch.sim.act[:] = 1.0 * (np.asarray(controls)[2:] > 0)
    batch.sim.write(states)
    batch.sim.control(np.tile(np.asarray(controls, dtype=float), (4, 1)))
    batch.sim.step(1)
    return batch.sim.actuator_force.copy()


def test_masses_payload_and_friction():
    conditions = farm.Robust(mass=(0.5, 2.0), payload=(1.0, 3.0), friction=(0.4, 0.6), body="block")
    batch = batch_of(Free, conditions)
    drawn = batch.start["robust/conditions"]
    sim = batch.sim
    assert [channel.labels for channel in specification(task_with(conditions)).channels] == [
        ("mass", "payload", "friction")
    ]
    factor, load, friction = drawn.T
    assert drawn[1].tolist() == [1.0, 0.0, 1.0]
    assert ((factor > 0.5) & (factor < 2.0)).all()
    assert (load[[0, 2, 3]] > 1.0).all()
    assert np.array_equal(
        sim.expand("body_mass")[:, 1:], np.stack([2 * factor, 4 * factor + load], axis=1)
    )
    assert np.allclose(
        sim.expand("body_inertia")[:, 2], Free().model.body_inertia[2] * factor[:, None]
    )
    assert np.array_equal(sim.expand("geom_friction")[:, 0, 0], friction)


def task_with(conditions, kind=Free, **settings):
    task = kind(kind.Config(**settings))
    task.robust = conditions
    return task


def test_a_push_gives_its_impulse_once_and_leaves_the_tasks_own_forces():
    class Blown(Free):
        """A wind that is set once."""

        def act(self, sim, action):
            """It blows from the first step on."""
            if sim.t == 0:
                sim.body("block").xfrc_applied[:, 2] = 4.0
            return super().act(sim, action)

    conditions = farm.Robust(push=(5.0, 10.0), push_duration=0.2, pushes=2, body="block")
    batch = batch_of(Blown, conditions)
    acted(batch, np.zeros(4))
    velocity = batch.sim.qvel[:, 1:4]
    push = batch.frames["robust/push"][:, :, 0, 3:]  # (B, T, 3)
    assert np.allclose(velocity[:, :2], push.sum(axis=1)[:, :2] * 0.05 / 4.0, atol=1e-9)
    assert np.allclose(velocity[:, 2], 1.0), "1 s of 4 N"
    assert not push[1].any(), "nominal"
    size = np.linalg.norm(push[[0, 2, 3]], axis=2)
    for half in (size[:, :10], size[:, 10:]):
        assert ((half > 0).sum(axis=1) == 4).all(), "0.2 s in each half"
    assert (size.max(axis=1) <= 10.0).all()
    assert (size[size > 0] >= 5.0).all()
    begins = (size > 0).argmax(axis=1)
    assert len(set(begins.tolist())) > 1


def test_observations_are_as_old_as_drawn_and_actions_late():
    conditions = farm.Robust(observation_delay=(0.06, 0.19), action_delay=(0.1, 0.1))
    batch = batch_of(Free, conditions)
    ages = batch.start["robust/conditions"][:, 0] / 0.05
    assert ages[1] == 0.0
    times = acted(batch, np.zeros(4))[:, :, 0]  # (T, B), what the time seemed to be [control steps]
    expected = np.maximum(np.arange(20)[:, None] - ages, 0.0)
    assert np.allclose(times[4:], expected[4:])
    assert (times[0] == 0.0).all()
    late = batch_of(Free, conditions)
    for t in range(6):
        late.observe()
        late.step(np.full((4, 4), float(t)) * [1.0, 0, 0, 0])
        assert late.sim.ctrl[:, 0].tolist() == [
            max(t - 2, 0),
            t,
            max(t - 2, 0),
            max(t - 2, 0),
        ], "two control steps"


def test_noise_and_bias_of_parts_are_what_the_policy_sees_and_what_is_recorded():
    class Parts(Pole):
        """Two parts: readings and the goal."""

        parts = (3, 1)
        robust = farm.Robust(noise=(0.0, 0.1), bias=(0.2, 0.0))

    seeds = [None, *((i, 0, 0, 0) for i in range(60))]
    plain, noisy = (batch_of(kind, kind.robust, seeds=seeds) for kind in (Pole, Parts))
    errors = noisy.observe() - plain.observe()
    assert not errors[0].any()
    assert np.abs(errors[1:, :3]).max() < 0.2
    assert np.abs(errors[1:, :3]).std() > 0.03
    assert 0.07 < errors[1:, 3].std() < 0.13
    plain.step(np.zeros((61, 1)))
    noisy.step(np.zeros((61, 1)))
    later = noisy.observe() - plain.observe()
    assert np.allclose(later[:, :3], errors[:, :3], atol=1e-12), "a bias stays"
    assert not np.allclose(later[1:, 3], errors[1:, 3], atol=1e-3)


def test_what_is_recorded_and_normalised_is_what_the_policy_saw():
    task = task_with(farm.Robust(observation_delay=(0.1, 0.1), noise=0.01))
    spec = specification(task)
    config = LinearConfig()
    policy = Linear(config, spec, Linear.draw(config, spec, np.random.default_rng(0)))
    sim = Sim(task.engine(BatchEngine))
    seeds = [None, (1, 2, 3, 4)]
    theta = np.zeros((2, policy.size))
    rollouts, trouble = loop.run(
        task, policy, sim, theta, seeds, spec, Kept(moments=True, observations=True)
    )
    assert not trouble.errors
    times = rollouts.observations[:, :, 0]
    assert times[0].tolist() == list(range(20))
    expected = np.maximum(np.arange(20) - 2.0, 0.0)
    assert 0.002 < np.abs(times[1] - expected).max() < 0.05
    assert np.allclose(rollouts.moments[:, 1], times.mean(axis=1), rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"motors": (1.2, 0.8)}, "motors is 1.2 to 0.8; expected the lower end first"),
        ({"motors": (0.0, 1.0)}, "motors is 0 to 1; expected factors above 0"),
        ({"noise": -0.1}, "noise is -0.1; expected a size from 0"),
        (
            {"noise": (0.1, float("nan"))},
            "noise is (0.1, nan); expected a number, or one for each observed number",
        ),
        ({"bias": "much"}, "bias is 'much'; expected a number"),
        ({"push": 5.0}, "push is 5.0; expected a range, as (0.8, 1.2)"),
        ({"observation_delay": (-0.1, 0.1)}, "observation_delay is -0.1 to 0.1; expected 0 to"),
        ({"push_duration": 0.0}, "push_duration is 0.0; expected a positive number of seconds"),
        ({"pushes": 0}, "pushes is 0; expected a whole number from 1"),
        ({"body": 3}, "body is 3; expected the name of a body"),
    ],
)
def test_a_declaration_that_makes_no_sense_is_one_line(settings, words):
    with pytest.raises(ConfigError) as error:
        farm.Robust(**settings)
    assert str(error.value).startswith(f"robust: {words}")


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        (
            farm.Robust(observation_delay=(0.0, 1.0)),
            "observation_delay is up to 1 s; a rollout takes 1 s",
        ),
        (
            farm.Robust(noise=(0.1, 0.2, 0.3)),
            "noise has 3 numbers; expected 1 or 2 (one for each observed number)",
        ),
        (
            farm.Robust(push=(0.0, 1.0), body="trunk"),
            "there is no body 'trunk'; the model has ball, block",
        ),
        (
            farm.Robust(payload=(0.0, 1.0), body="world"),
            "body 'world' cannot move; those that can are ball, block",
        ),
        (farm.Robust(push=(0.0, 1.0), pushes=9), "9 pushes of 0.2 s; a rollout takes 1 s"),
        ("all", "robust is 'all'; expected a farm.Robust"),
    ],
)
def test_conditions_that_do_not_fit_the_task_are_one_line(conditions, words):
    with pytest.raises(ConfigError) as error:
        specification(task_with(conditions))
    assert words in str(error.value)


def test_a_strength_without_conditions_and_one_that_makes_delays_too_long_are_refused():
    with pytest.raises(ConfigError, match=r"robust is 2, but task Free declares no farm\.Robust"):
        specification(task_with(None, robust=2.0))
    with pytest.raises(ConfigError, match=r"action_delay is up to 1\.2 s"):
        specification(task_with(farm.Robust(action_delay=(0.0, 0.6)), robust=2.0))


def test_causes_alone_and_strengths():
    assert ALL.only("motors").causes == ("motors",)
    assert ALL.only("motors").motors == ALL.motors
    assert ALL.only("noise").noise == ALL.noise
    assert ALL.scaled(0.0).causes == ()
    twice = ALL.scaled(2.0)
    assert twice.motors == pytest.approx((0.6, 1.4))
    assert twice.friction == (0.05, 2.0), "no factor is below 0.05"
    assert twice.noise == (0.02, 0.04, 0.06, 0.08)
    assert twice.push == (2.0, 6.0)


def test_a_pid_is_no_motor_whose_force_is_known():
    class Custom(Free):
        """An actuator of the user's own."""

        xml = """<mujoco>
          <worldbody><body><joint name="x"/><geom size="0.1"/></body></worldbody>
          <actuator><general name="own" joint="x" gaintype="user"/></actuator>
        </mujoco>"""

    with pytest.raises(ConfigError, match="actuator 'own' is neither a motor nor a servo"):
        specification(task_with(farm.Robust(motors=(0.5, 1.0)), Custom))


def test_an_engine_that_cannot_push_says_so():
    class Fixed(BatchEngine):
        """Nothing is writable."""

        writable = ()

    task = task_with(farm.Robust(push=(0.0, 1.0), body="block"))
    sim = Sim(Fixed(task.model, 1))
    with pytest.raises(
        TaskError, match="robust: nothing can be pushed in an environment that steps itself"
    ):
        Batch(task, sim, [(1, 0, 0, 0)])


def test_pairs_of_geometries_have_their_own_friction():
    class Pairs(Free):
        """A pair with a friction of its own."""

        xml = Free.xml.replace(
            "</worldbody>",
            '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -3"/></worldbody>'
            '<contact><pair geom1="ball" geom2="floor" friction="0.5"/></contact>',
        )

    batch = batch_of(Pairs, farm.Robust(friction=(0.4, 0.6)))
    drawn = batch.start["robust/conditions"][:, 0]
    assert np.array_equal(batch.sim.expand("pair_friction")[:, 0, 0], 0.5 * drawn)
    assert mujoco.mj_name2id(batch.sim.model, mujoco.mjtObj.mjOBJ_GEOM, "floor") >= 0


def test_an_environment_that_steps_itself_has_errors_and_delays_but_one_model():
    task = Environment(Environment.Config(steps=4), "HumanoidStandup-v5")
    sim = Sim(task.engine(BatchEngine))
    seeds = [(1, 0, 0, 0), None]
    plain = Batch(task, sim, seeds).observe().copy()
    task.robust = farm.Robust(bias=0.5, observation_delay=(0.0, 0.03))
    specification(task)
    seen = Batch(task, sim, seeds).observe()
    assert np.array_equal(seen[1], plain[1]), "nominal"
    assert 0.3 < np.abs(seen[0] - plain[0]).max() < 0.5
    task.robust = farm.Robust(mass=(0.5, 2.0))
    with pytest.raises(
        TaskError,
        match="body_mass cannot differ between rollouts in an environment that steps itself",
    ):
        Batch(task, sim, seeds)
    sim.engine.close()


class Several(Pole):
    """Poles of two lengths, the second with a geometry more."""

    robust = ALL

    def models(self):
        """Two."""
        longer = XML.replace("0.4", "0.6").replace(
            '<geom type="capsule"', '<geom size="0.05"/><geom type="capsule"'
        )
        return [XML, longer]


def test_conditions_of_several_models_do_not_depend_on_the_batch():
    runner = new_runner(Several)
    theta = thetas(runner, 7, 4.0)
    seeds = [None, *((i, 2, 3, 4) for i in range(6))]
    together = runner.rollouts(theta, seeds)
    assert set(together.which.tolist()) == {0, 1}
    for row in range(7):
        same(together, row, runner.rollouts(theta[row : row + 1], [seeds[row]]), 0)


def test_conditions_grow_with_the_generation_of_a_learning_rollout_only():
    words = [seeds.training(4, generation, 3) for generation in (0, 5, 10, 30)]
    others = [None, seeds.validation(4, 0), seeds.evaluation_start(4, 7)]
    runner = new_runner(Disturbed, width=0.3, robust_ramp=10)
    theta = np.repeat(thetas(runner, 1, 4.0), 4, axis=0)
    grown = arrays(runner.rollouts(theta, words))
    full = arrays(new_runner(Disturbed, width=0.3).rollouts(theta, words))
    without = arrays(new_runner(Disturbed, width=0.3, robust=0.0).rollouts(theta, words))
    half = arrays(new_runner(Disturbed, width=0.3, robust=0.5).rollouts(theta, words))
    for row, like in enumerate((without, half, full, full)):
        assert grown["returns"][row] == pytest.approx(like["returns"][row], abs=1e-9), row
    assert len({*full["returns"].tolist(), *half["returns"].tolist()}) == 8
    ramped = arrays(runner.rollouts(theta[:3], others))
    plain = arrays(new_runner(Disturbed, width=0.3).rollouts(theta[:3], others))
    assert ramped["returns"].tolist() == plain["returns"].tolist()
