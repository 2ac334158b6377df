"""Errors of the hand's readings, and the servos' stiffness."""

from typing import Any

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.runner import Runner
from farm.tasks.finger_gait.fragile_bar import FragileBarConfig
from farm.tasks.finger_gait.hand import JOINTS
from farm.tasks.finger_gait.sensing import ZERO, Perturbation, SensingConfig
from farm.tasks.loop import Batch
from farm.tasks.rollouts import Seed
from learner.run.config import configure
from learner.run.setup import problem

pytestmark = pytest.mark.usefixtures("grips_found_once")
SEEDS: list[Seed] = [(5, 0, 0, i) for i in range(6)]
EXACT = {"force_noise": 0.0, "force_hysteresis": 0.0, "force_dropout": 0.0}
CLOSING = np.array([0.0, 0.0, 0.0, 0.02, 0.02, 0.02, 0.0, 0.0])


def observed(
    task: str = "fragile-bar", action: np.ndarray = CLOSING, **settings: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Observations (T, B, d) of rollouts that repeat an action, and the fingers' true forces (T, B,
    3).
    """
    runner: Runner = problem(configure(task, **(EXACT | settings))).runner()
    try:
        batch, observations, force = Batch(runner.task, runner.sim, SEEDS), [], []
        while not batch.over:
            x = np.full((len(SEEDS), runner.task.spec().observation), np.nan)
            f = np.full((len(SEEDS), 3), np.nan)
            x[batch.active] = batch.observe()
            f[batch.active] = runner.task.measure(runner.sim)["force"].sum(axis=-1)
            observations.append(x)
            force.append(f)
            batch.step(np.tile(action, (len(runner.sim), 1)))
        return np.stack(observations), np.stack(force)
    finally:
        runner.close()


@pytest.mark.slow
def test_readings_have_no_errors_but_noise_and_bias_unless_asked():
    x, force = observed()
    np.testing.assert_allclose(x, force, atol=1e-12)
    joints, _ = observed(state="joints", joint_bias=0.0, joint_noise=0.0)
    noisy, _ = observed(state="joints", joint_bias=0.0, joint_noise=0.03)
    assert np.nanstd(noisy - joints) == pytest.approx(0.03, rel=0.1)


def test_the_fragile_bars_forces_are_read_with_errors():
    bar = FragileBarConfig()
    assert (bar.force_noise, bar.force_hysteresis, bar.force_dropout, bar.force_delay) == (
        0.05,
        0.1,
        0.01,
        0,
    )
    assert bar.numb
    assert not SensingConfig().numb


def test_a_bias_is_constant_and_a_drift_grows_as_a_random_walk():
    errors = SensingConfig(joint_noise=0.0, joint_bias=0.1)
    noise = np.stack(
        [Perturbation.draw(np.random.default_rng(i), 25, errors).noise for i in range(200)]
    )
    assert (noise == noise[:, :1]).all()
    assert 0.09 < np.abs(noise).max() <= 0.1
    errors = SensingConfig(joint_noise=0.0, joint_drift=0.01)
    noise = np.stack(
        [Perturbation.draw(np.random.default_rng(i), 25, errors).noise for i in range(200)]
    )
    spread = noise.std(axis=(0, 2))
    np.testing.assert_allclose(spread, 0.01 * np.sqrt(np.arange(1, 26)), rtol=0.1)


@pytest.mark.parametrize("state", ["forces", "tactile", "cop"])
def test_late_readings_are_those_of_earlier_steps(state: str):
    now, _ = observed(state=state)
    late, _ = observed(state=state, force_delay=3)
    np.testing.assert_array_equal(late[3:], now[:-3])
    np.testing.assert_array_equal(late[:3], np.repeat(now[:1], 3, axis=0))


def test_hysteresis_keeps_a_reading_within_its_share_of_the_force():
    now, _ = observed(state="tactile")
    lazy, _ = observed(state="tactile", force_hysteresis=0.2)
    before = lazy[:-1]
    low, high = 0.8 * now[1:], 1.2 * now[1:]
    in_band = (before >= low) & (before <= high)
    assert 0.05 < in_band[now[1:] > 0].mean() < 0.95, (
        "of those with a force some stay and some move"
    )
    np.testing.assert_array_equal(lazy[1:][in_band], before[in_band])
    np.testing.assert_allclose(
        lazy[1:][~in_band & ~np.isnan(now[1:])],
        np.clip(before, low, high)[~in_band & ~np.isnan(now[1:])],
    )


def test_lost_readings_repeat_the_last_one():
    now, _ = observed()
    gaps, _ = observed(force_dropout=0.4)
    new = gaps[1:] == now[1:]
    repeated = gaps[1:] == gaps[:-1]
    active = ~np.isnan(now[1:])
    assert (new | repeated)[active].all()
    assert (~new)[active & (now[1:] != now[:-1])].mean() == pytest.approx(0.4, abs=0.1)


def test_noise_is_that_of_a_fingers_total_and_nothing_touched_reads_nothing():
    x, force = observed(force_noise=0.05, action=np.zeros(8))
    pressed = force[..., [0, 2]] > 1.0
    assert np.std((x - force)[..., [0, 2]][pressed]) == pytest.approx(0.05, rel=0.15)
    assert (x[..., 1][force[..., 1] == 0] == 0).all()
    tactile, _ = observed(state="tactile", force_noise=0.05, action=np.zeros(8))
    np.testing.assert_allclose(tactile.reshape(*x.shape, -1).sum(axis=-1), x, atol=1e-12)


def test_a_zeroed_hand_holds_still_first_and_sees_no_constant_error():
    x, _ = observed(state="zeroed", joint_noise=0.0, joint_bias=0.0)
    biased, _ = observed(state="zeroed", joint_noise=0.0, joint_bias=0.5)
    assert (x[:ZERO] == 0).all()
    np.testing.assert_allclose(biased, x, atol=1e-9)
    assert x.shape[-1] == len(JOINTS)
    assert np.nanmax(x[-1, :, 3:6].sum(axis=-1)) > 1.2, "the middle finger presses"


@pytest.mark.slow
def test_stiffer_servos_are_pushed_back_less():
    runner = problem(configure("fragile-bar", stiffness=4.0)).runner()
    assert runner.task.model.actuator_gainprm[:, 0].tolist() == [12.0] * 8
    assert runner.task.model.actuator_biasprm[:, 1].tolist() == [-12.0] * 8
    runner.close()
    soft, stiff = (
        observed(
            state="zeroed", joint_noise=0.0, joint_bias=0.0, action=CLOSING / 4, stiffness=factor
        )[0]
        / factor
        for factor in (1.0, 4.0)
    )  # as forces by the servos' stiffness; without it, as angles
    for each in (soft, stiff):
        assert (each[:ZERO] == 0.0).all()
    assert (np.abs(stiff).mean(axis=(0, 1)) < 0.7 * np.abs(soft).mean(axis=(0, 1))).all()


@pytest.mark.parametrize(
    ("task", "settings"), [("finger-gait", {"state": "tactile", "perturb": True}), ("turning", {})]
)
def test_every_hand_has_these_errors(task: str, settings: dict[str, Any]):
    clean, _ = observed(task, np.zeros(8), **settings)
    late, _ = observed(task, np.zeros(8), force_delay=1, **settings)
    active = ~np.isnan(late[1:, :, -3:])
    np.testing.assert_allclose(late[1:, :, -3:][active], clean[:-1, :, -3:][active], atol=1e-12)
    assert (late[1:, :, -3:] != clean[1:, :, -3:])[active].any()


@pytest.mark.parametrize(
    ("name", "value"),
    [("joint_drift", -0.1), ("force_dropout", 1.5), ("force_delay", -1), ("stiffness", 0.0)],
)
def test_a_wrong_setting_is_named(name: str, value: float):
    with pytest.raises(ConfigError, match=name.replace("_", "-")):
        FragileBarConfig(**{name: value})
