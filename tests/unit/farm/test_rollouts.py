"""Jobs to results: signs, origins, rates, traces and trajectories; and specifications that make no sense."""

import dataclasses

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.net import codec
from farm.net.work import Job
from farm.net.messages import Spec
from farm.net.work import Result, Results, WireTrajectory
from farm.policies.fourier import Features, PolicyConfig
from farm.tasks import TASKS
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.physics import CAPACITY, Stepper
from farm.tasks.finger_gait.task import TIMESTEP, Perturbation, TaskConfig
from workers.backends import BACKENDS
from workers.backends.cpu import CpuBackend
from workers.jobs import parameters
from workers.tasks import SIMULATES

P = 64


def make_spec(task=None, policy=None, seed=0, **changes):
    config = TaskConfig(**(task or {}))
    controller = PolicyConfig(**({"features": 50} | (policy or {})))
    drawn = Features.draw(controller, STATES[config.state].size, np.random.default_rng(seed))
    values = {
        "run": "run-1",
        "task": "finger-gait",
        "task_config": dataclasses.asdict(config),
        "policy_config": dataclasses.asdict(controller),
        "frequencies": drawn.frequencies,
        "phases": drawn.phases,
    }
    return Spec(**(values | changes))


@pytest.fixture(scope="module")
def backend():
    return CpuBackend(codec.decode(codec.encode(make_spec()), Spec))


RNG = np.random.default_rng(1)
MU = RNG.normal(1.0, 1.0, P)


def job(index=0, **changes):
    values = {
        "index": index,
        "origin": "mu",
        "signs": (1, -1),
        "perturbation": None,
        "rate": "none",
        "eps": np.random.default_rng([5, index]).normal(0.0, 2.0, P),
    }
    return Job(**(values | changes))


MEAN = {"signs": (1,), "eps": np.zeros(0)}


def arrays(result):
    return {
        f.name: getattr(result, f.name) for f in dataclasses.fields(Result) if f.name not in ("index", "trajectory")
    }


def assert_rows_equal(one, row, two, other_row):
    for name, values in arrays(one).items():
        assert values[row].tobytes() == arrays(two)[name][other_row].tobytes(), name


# ---------------------------------------------------------------- figures


def test_backends_by_name(backend):
    assert BACKENDS == {"cpu": CpuBackend}
    assert backend.capacity == CAPACITY
    assert backend.parameters == P
    backend.close()


def test_results_answer_the_jobs_in_their_order(backend):
    jobs = [
        job(7),
        job(2, rate="physics", **MEAN),
        job(5, signs=(1,)),
        job(0, rate="control"),
        job(1, perturbation=(3, 0, 0, 0)),
    ]
    results = backend.run(MU, jobs)
    assert [result.index for result in results] == [7, 2, 5, 0, 1]
    for asked, result in zip(jobs, results, strict=True):
        assert len(result.returns) == len(asked.signs)
        assert result.traces.shape == (len(asked.signs), 15, 54)
        assert (result.trajectory is None) == (asked.rate == "none")
        dtypes = {name: values.dtype.str for name, values in arrays(result).items()}
        assert dtypes == {
            "returns": "<f8",
            "success": "|b1",
            "dropped": "|b1",
            "failed": "|b1",
            "clamped": "|b1",
            "traces": "<f4",
        }


def travelled(*results):
    """Results as the learner sees them."""
    sent = Results.of(results, run="r", incarnation="i", round=0, worker="w/0", traces="extremes")
    return codec.decode(codec.encode(sent), Results)


@pytest.mark.parametrize("perturbation", [None, (1, 2, 3, 4)])
def test_a_pair_is_two_single_jobs(backend, perturbation):
    pairs = [job(i, perturbation=perturbation) for i in range(6)]
    for asked, pair in zip(pairs, backend.run(MU, pairs), strict=True):
        for row, sign in enumerate((1, -1)):
            (single,) = backend.run(MU, [dataclasses.replace(asked, signs=(sign,))])
            assert_rows_equal(pair, row, single, 0)
            away = MU + sign * asked.eps
            (absolute,) = backend.run(MU, [dataclasses.replace(asked, signs=(1,), origin="zero", eps=away)])
            assert_rows_equal(pair, row, absolute, 0)
        (swapped,) = backend.run(MU, [dataclasses.replace(asked, signs=(-1, 1))])
        assert_rows_equal(pair, 0, swapped, 1)
        assert pair.returns[0] != pair.returns[1]


def test_jobs_do_not_know_of_each_other(backend):
    jobs = [
        job(i, perturbation=None if i % 3 else (9, i, 0, 0), rate=("none", "control", "physics")[i % 3 if i < 6 else 0])
        for i in range(CAPACITY // 2 + 4)
    ]
    together = backend.run(MU, jobs)
    for asked, result in zip(jobs, together, strict=True):
        (alone,) = backend.run(MU, [asked])
        for row in range(2):
            assert_rows_equal(result, row, alone, row)
    backwards = backend.run(MU, jobs[::-1])[::-1]
    for one, two in zip(together, backwards, strict=True):
        for row in range(2):
            assert_rows_equal(one, row, two, row)
        assert codec.encode(one) == codec.encode(two)


def test_another_backend_gives_the_same(backend):
    jobs = [job(0), job(1, perturbation=(4, 0, 0, 0)), job(2, rate="physics", **MEAN)]
    other = CpuBackend(make_spec())
    other.run(-MU, [job(8, perturbation=(5, 0, 0, 0))])
    assert [codec.encode(r) for r in other.run(MU, jobs)] == [codec.encode(r) for r in backend.run(MU, jobs)]


def test_without_eps_it_is_the_mean(backend):
    results = backend.run(
        MU, [job(0, **MEAN), job(1, signs=(1,), eps=np.zeros(P)), job(2, signs=(1, -1), eps=np.zeros(0))]
    )
    assert_rows_equal(results[0], 0, results[1], 0)
    for row in (0, 1):
        assert_rows_equal(results[0], 0, results[2], row)


def test_parameters_of_a_job():
    asked = job(0, eps=np.arange(3.0))
    mu = np.array([10.0, 20.0, 30.0])
    np.testing.assert_array_equal(parameters(mu, asked), [[10, 21, 32], [10, 19, 28]])
    np.testing.assert_array_equal(parameters(mu, dataclasses.replace(asked, origin="zero")), [[0, 1, 2], [0, -1, -2]])
    np.testing.assert_array_equal(parameters(mu, dataclasses.replace(asked, **MEAN)), [mu])
    np.testing.assert_array_equal(parameters(mu, dataclasses.replace(asked, origin="zero", **MEAN)), [[0, 0, 0]])
    assert mu.tolist() == [10, 20, 30]


def test_the_seed_of_a_perturbation_is_all_there_is_to_it(backend):
    seeds = [(1, 5, 0, 0), (1, 5, 0, 0), (2, 5, 0, 0), (1, 6, 0, 0)]
    results = backend.run(MU, [job(i, perturbation=seed, **MEAN) for i, seed in enumerate(seeds)])
    assert_rows_equal(results[0], 0, results[1], 0)
    assert len({result.returns[0] for result in results}) == 3
    drawn = Perturbation.draw(np.random.default_rng((2, 5, 0, 0)), 15)
    rollouts = backend._task._simulation.run(MU[None], [drawn])
    assert rollouts.outcome.returns[0] == results[2].returns[0]


@pytest.mark.parametrize("rate", ["none", "control", "physics"])
def test_the_rate_changes_no_figure(backend, rate):
    for perturbation in (None, (3, 0, 0, 0)):
        asked = job(2, perturbation=perturbation)
        one, two = backend.run(MU, [dataclasses.replace(asked, index=i, rate=r) for i, r in enumerate(("none", rate))])
        for row in range(2):
            assert_rows_equal(one, row, two, row)


# ---------------------------------------------------------------- trajectories


def seen(backend, rate, eps=None, **changes):
    """Return a rollout's result and its trajectory."""
    eps = np.zeros(0) if eps is None else eps
    (result,) = backend.run(MU, [job(0, signs=(1,), eps=eps, rate=rate, **changes)])
    return result, result.trajectory.trajectory()


def steps_of(result):
    """Return after how many control steps a rollout ended, of which there is a frame each."""
    return len(result.trajectory.times) - 1


@pytest.fixture(scope="module")
def dropping(backend):
    """Parameters with which the object is dropped after some steps."""
    for seed in range(100):
        eps = np.random.default_rng(seed).normal(0.0, 2.0, P)
        (result,) = backend.run(MU, [job(0, signs=(1,), eps=eps, rate="control")])
        if 2 < steps_of(result) < 15:
            assert result.dropped[0]
            return eps
    pytest.fail("nothing was dropped")


@pytest.mark.parametrize("ending", ["lasting", "dropping"])
@pytest.mark.parametrize(("rate", "parts"), [("control", 1), ("physics", 10)])
def test_a_trajectory_is_the_rollout_frame_by_frame(backend, dropping, rate, parts, ending):
    eps = dropping if ending == "dropping" else np.zeros(0)
    result, shown = seen(backend, rate, eps, perturbation=(6, 0, 0, 0))
    steps = steps_of(backend.run(MU, [job(0, signs=(1,), eps=eps, rate="control", perturbation=(6, 0, 0, 0))])[0])
    assert (steps < 15) == (ending == "dropping")
    frames = steps * parts + 1
    for name in ("times", "bodies", "joints", "targets", "images", "points", "terms"):
        assert len(getattr(shown, name)) == frames, name
    np.testing.assert_allclose(shown.times, np.arange(frames) * 0.1 / parts, atol=1e-12)
    assert shown.value == result.returns[0]
    assert shown.success == result.success[0]
    for t in range(steps):
        image = shown.images[(t + 1) * parts].reshape(54).astype("f4")
        assert image.tobytes() == result.traces[0, t].tobytes()
    assert not result.traces[0, steps:].any()
    np.testing.assert_array_equal(shown.terms[0], 0.0)
    held = shown.terms[1:].reshape(steps, parts, 5)  # the terms of a control step, at each of its frames
    assert (held == held[:, :1]).all()
    rewards = held[:, 0].sum(axis=1)
    assert 0.1 * np.sum(0.95 ** np.arange(steps) * rewards) == pytest.approx(shown.value, rel=1e-5)
    np.testing.assert_array_equal(shown.targets[0], backend._task._simulation.task.commands.astype("f4"))
    points = tactile.contact_points(shown.images)
    np.testing.assert_allclose(shown.points, points, atol=1e-5)


@pytest.mark.parametrize("ending", ["lasting", "dropping"])
def test_physics_rate_passes_through_the_frames_of_control_rate(backend, dropping, ending):
    eps = dropping if ending == "dropping" else None
    (_, coarse), (_, fine) = seen(backend, "control", eps), seen(backend, "physics", eps)
    for name in ("bodies", "joints", "targets", "images", "points", "terms"):
        np.testing.assert_array_equal(getattr(fine, name)[::10], getattr(coarse, name), err_msg=name)
    np.testing.assert_allclose(fine.times[::10], coarse.times, atol=1e-12)
    assert np.diff(fine.times) == pytest.approx(TIMESTEP)


def test_targets_hold_for_a_control_step(backend):
    _, fine = seen(backend, "physics")
    held = fine.targets[1:].reshape(15, 10, 8)
    assert (held == held[:, :1]).all()
    assert (np.diff(held[:, 0], axis=0) != 0).any()


def test_bodies_stand_where_the_joints_put_them(backend):
    _, shown = seen(backend, "control")
    scene = backend._task._simulation.scene
    assert shown.bodies.shape == (16, len(scene.bodies), 7)
    qpos = np.concatenate([shown.joints, shown.bodies[:, scene.bodies.index("object")]], axis=1)
    np.testing.assert_allclose(scene.poses(qpos), shown.bodies, atol=1e-6)


def test_a_pair_shows_its_first_rollout(backend):
    (pair,) = backend.run(MU, [job(0, rate="control")])
    assert pair.trajectory.value == pair.returns[0]


def test_a_failed_rollout_can_be_shown_and_sent(monkeypatch):
    backend = CpuBackend(make_spec())
    blown_up = Stepper.blown_up
    calls = []

    def after_three(self, ids):
        calls.append(ids)
        return blown_up(self, ids) | (len(calls) == 4)

    monkeypatch.setattr(Stepper, "blown_up", after_three)
    (result,) = backend.run(MU, [job(0, rate="physics", **MEAN)])
    assert result.failed[0]
    assert not result.dropped[0]
    shown = travelled(result).trajectories[0].trajectory()
    assert len(shown.times) == 41
    np.testing.assert_array_equal(shown.terms[-1], [0, 0, 0, 0, -400])


@pytest.mark.parametrize("size", [1e200, 1e308])
@pytest.mark.parametrize("clip", [True, False])
def test_absurd_parameters_are_answered(clip, size):
    backend = CpuBackend(make_spec(policy={"controller": "direct", "clip": clip}))
    eps = np.where(np.arange(backend.parameters) % 2, 1.0, -1.0) * size
    results = backend.run(np.zeros(backend.parameters), [job(0, eps=eps, rate="control")])
    back = travelled(*results)
    clamped = back.flags[:, 3]
    assert clamped.all()
    assert (back.returns == -1e12).all()
    assert isinstance(back.trajectories[0], WireTrajectory)


# ---------------------------------------------------------------- specifications


def test_both_sides_know_the_same_tasks():
    assert list(TASKS) == list(SIMULATES)


def test_an_unknown_task_names_the_known_ones():
    with pytest.raises(ConfigError, match="unknown task 'juggling'; known are finger-gait"):
        CpuBackend(dataclasses.replace(make_spec(), task="juggling"))


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("task_config", {"colour": "red"}, "does not understand.*colour"),
        ("task_config", {"object": "spoon"}, "unknown object 'spoon'"),
        ("task_config", {"object": ["bar"]}, "unknown object"),
        ("task_config", {"start_grip": ["index"]}, "does not understand|unknown grip"),
        ("task_config", {"goal_grip": "none"}, "unknown grip 'none'"),
        ("task_config", {"steps": 2}, "steps is 2"),
        ("task_config", {"steps": "15"}, "does not understand|steps"),
        ("task_config", {"steps": 15.5}, "does not understand|steps"),
        ("task_config", {"steps": np.array([15, 15])}, "does not understand|steps"),
        ("task_config", {"gamma": None}, "does not understand"),
        ("policy_config", {"controller": "magic"}, "unknown controller 'magic'"),
        ("policy_config", {"controller": {}}, "does not understand|unknown controller"),
        ("policy_config", {"bandwidth": "wide"}, "does not understand"),
        ("policy_config", {"bandwidth": np.ones(2)}, "does not understand"),
        ("policy_config", {"depth": 3}, "does not understand.*depth"),
        ("policy_config", {b"features": 50}, "does not understand"),
    ],
    ids=str,
)
def test_a_specification_that_makes_no_sense_is_a_clear_error(part, change, message):
    spec = make_spec()
    with pytest.raises(ConfigError, match=message):
        CpuBackend(dataclasses.replace(spec, **{part: getattr(spec, part) | change}))


@pytest.mark.parametrize(
    ("frequencies", "phases"), [((50, 17), 50), ((50, 8), 49), ((0, 8), 50), ((8, 50), 50), ((1, 8), 50)], ids=str
)
def test_features_of_another_size_are_a_clear_error(frequencies, phases):
    with pytest.raises(ConfigError, match=r"features of shape \(\d+, \d+\) for 8 state components"):
        CpuBackend(dataclasses.replace(make_spec(), frequencies=np.zeros(frequencies), phases=np.zeros(phases)))


@pytest.mark.parametrize("controller", ["direct", "projected", "cosine", "kernel"])
@pytest.mark.parametrize("state", list(STATES))
def test_parameter_counts(controller, state):
    backend = CpuBackend(make_spec({"state": state}, {"controller": controller}))
    expected = 8 * (50 if controller in ("direct", "cosine") else STATES[state].size)
    assert backend.parameters == expected
    (result,) = backend.run(np.ones(expected), [job(0, **MEAN)])
    assert np.isfinite(result.returns).all()
