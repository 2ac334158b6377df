"""What a seed perturbs: the same numbers for ever, in the same order, within their ranges."""

from dataclasses import fields

import numpy as np
import pytest

from farm.tasks.finger_gait.sensing import DISPLACEMENT, Perturbation, SensingConfig

STEPS = 15
ORACLE = {
    "friction": 1.1868755400377755,
    "mass": 0.9358703521697765,
    "displacement": [-0.000977337657837836, -0.0003862596859837662, 0.000796141017884563],
    "noise": [-0.005056647507339969, -0.009166622744730677, 0.0001734221675778827],
}
"""First numbers of seed 2016."""


def test_the_numbers_drawn_for_a_seed_never_change():
    perturbation = Perturbation.draw(np.random.default_rng(2016), STEPS, SensingConfig())
    assert perturbation.friction == ORACLE["friction"]
    assert perturbation.mass == ORACLE["mass"]
    assert perturbation.displacement.tolist() == ORACLE["displacement"]
    assert perturbation.noise[0, :3].tolist() == ORACLE["noise"]


def test_the_same_seed_draws_the_same():
    errors, seeds = SensingConfig(force_noise=0.1, force_dropout=0.5), ([1, 2], [1, 2], [1, 3])
    one, two, other = (
        Perturbation.draw(np.random.default_rng(seed), STEPS, errors) for seed in seeds
    )
    for field in fields(Perturbation):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
        assert np.any(getattr(one, field.name) != getattr(other, field.name))


@pytest.mark.parametrize("steps", [3, 40])
def test_the_order_of_draws_is_friction_mass_displacement_noise(steps):
    rng = np.random.default_rng(4)
    expected = (
        rng.uniform(0.8, 1.2),
        rng.uniform(0.8, 1.2),
        rng.uniform(-0.002, 0.002, 3),
        rng.normal(0, 0.01, (steps, 8)),
    )
    perturbation = Perturbation.draw(np.random.default_rng(4), steps, SensingConfig())
    for name, value in zip(("friction", "mass", "displacement", "noise"), expected, strict=True):
        np.testing.assert_array_equal(getattr(perturbation, name), value)


def test_draws_fill_their_ranges():
    rng = np.random.default_rng(0)
    perturbations = [Perturbation.draw(rng, STEPS, SensingConfig()) for _ in range(500)]
    for values in ([p.friction for p in perturbations], [p.mass for p in perturbations]):
        assert 0.8 <= min(values) < 0.81
        assert 1.19 < max(values) <= 1.2
    places = np.stack([p.displacement for p in perturbations])
    assert np.abs(places).max() <= DISPLACEMENT == 0.002
    assert (places.max(axis=0) > 0.0019).all()
    assert (places.min(axis=0) < -0.0019).all()
    noise = np.stack([p.noise for p in perturbations])
    assert noise.shape == (500, STEPS, 8)
    assert noise.std() == pytest.approx(0.01, rel=0.02)
    assert abs(noise.mean()) < 1e-4
