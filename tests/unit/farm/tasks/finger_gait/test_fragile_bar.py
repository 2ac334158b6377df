"""The fragile bar: success, differences between rollouts, and a policy that succeeds by touch."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.runner import Runner
from farm.tasks.base import Record
from farm.tasks.finger_gait.fragile_bar import (
    BREAKS,
    HEIGHT,
    TERMS,
    WINDOW,
    FragileBar,
    FragileBarConfig,
)
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Rollouts, Seed

pytestmark = pytest.mark.usefixtures("grips_found_once")

STEPS = FragileBar.steps
MIDDLE = FINGERS.index("middle")
EXACT = FragileBarConfig(state="cop", force_noise=0.0, force_hysteresis=0.0, force_dropout=0.0)
SEEDS: list[Seed] = [(5, 0, 0, i) for i in range(24)]


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    simulator = Runner(FragileBar(EXACT), SimpleNamespace(spec=None))  # type: ignore[arg-type]
    yield simulator
    simulator.close()


def played(runner: Runner, act: Any, seeds: list[Seed] = SEEDS) -> Rollouts:
    """Rollouts of actions that follow from the forces (n, 3) and the control step."""

    def play() -> Rollouts:
        batch = Batch(runner.task, runner.sim, seeds)
        while not batch.over:
            batch.step(act(batch.observe()[:, -3:], runner.sim.t))
        return batch.rollouts()

    rollouts: Rollouts = again(play)
    return rollouts


def closing(rate: Any, force: np.ndarray) -> np.ndarray:
    """Close the middle finger's last two joints by a rate [rad]."""
    action = np.zeros((len(force), len(JOINTS)))
    action[:, FINGER_JOINTS["middle"][:2]] = np.broadcast_to(rate, len(force))[:, None]
    return action


# ---------------------------------------------------------------- what is a success


def judged(
    middle: np.ndarray, index: float = 3.0, steps: int = STEPS, shift: float = 0.0
) -> tuple[np.ndarray, bool]:
    """Reward terms (T, 6) and success of one rollout with these forces of the middle finger."""
    force = np.zeros((1, STEPS, 3, 4))
    force[0, :, :, 0] = index
    force[0, :, MIDDLE, 0] = middle
    qpos = np.zeros((1, STEPS, 15))
    qpos[..., 11] = 1.0
    qpos[..., 8] = np.linspace(0.0, shift, STEPS)
    frames = {"qpos": qpos, "force": force, "target": np.zeros((1, STEPS, 8))}
    start = {"qpos": qpos[:, 0], "target": np.zeros((1, 8))}
    record = Record(
        frames,
        start,
        np.zeros((1, STEPS, 8)),
        np.array([steps]),
        np.array([False]),
        np.zeros(1, int),
    )
    score = FragileBar().score(record)
    assert score is not None
    assert score.success is not None
    return score.terms[0], bool(score.success[0])


def ending(force: float, before: float = 0.0) -> np.ndarray:
    return np.concatenate([np.full(STEPS - 3, before), np.full(3, force)])


@pytest.mark.parametrize(
    ("force", "good"), [(0.39, False), (0.41, True), (1.39, True), (1.41, False)]
)
def test_the_last_forces_lie_in_the_window(force: float, good: bool) -> None:
    assert judged(ending(force))[1] == good


@pytest.mark.parametrize(("peak", "good"), [(BREAKS - 0.01, True), (BREAKS + 0.01, False)])
def test_the_bar_breaks_once(peak: float, good: bool) -> None:
    force = ending(0.9)
    force[4] = peak
    assert judged(force)[1] == good


def test_the_other_fingers_hold_and_the_bar_stays() -> None:
    assert not judged(ending(0.9), index=0.05)[1]
    assert not judged(ending(0.9), shift=0.02)[1]
    assert not judged(ending(0.9), steps=STEPS - 1)[1]


def test_the_reward_is_best_at_the_wanted_force() -> None:
    totals = {
        force: judged(np.full(STEPS, force))[0].sum() for force in (0.0, 0.5, 0.9, 1.3, 2.0, 4.0)
    }
    assert max(totals, key=totals.__getitem__) == 0.9
    assert totals[0.9] == 0.0
    assert totals[4.0] < totals[2.0] < totals[1.3]


def test_a_drop_costs_every_step_that_is_left() -> None:
    terms, _ = judged(np.full(STEPS, 0.9), steps=10)
    drop = terms[:, TERMS.index("drop")]
    assert (drop[:10] == 0).all()
    assert (drop[10:] < 0).all()
    assert (terms[10:].sum(axis=1) == drop[10:]).all()


# ---------------------------------------------------------------- what differs


def test_a_higher_surface_is_touched_sooner(runner: Runner) -> None:
    rollouts = played(runner, lambda force, _: closing(0.02, force))
    first = (rollouts.frames["force"].sum(axis=-1)[..., MIDDLE] > 0).argmax(axis=1)
    heights = [np.random.default_rng(seed).uniform(-HEIGHT, HEIGHT) for seed in SEEDS]
    assert len(set(first.tolist())) > 3
    assert np.corrcoef(heights, first)[0, 1] < -0.8


def test_joint_readings_are_wrong_by_a_constant(runner: Runner) -> None:
    task = runner.task

    def noise(bias: float) -> np.ndarray:
        task.config = FragileBarConfig(joint_bias=bias)

        def look() -> np.ndarray:
            Batch(task, runner.sim, SEEDS)
            return np.array(runner.sim.own["noise"])

        return again(look)

    try:
        wrong = noise(0.05) - noise(0.0)
    finally:
        task.config = EXACT
    np.testing.assert_allclose(wrong, np.broadcast_to(wrong[:, :1], wrong.shape), atol=1e-15)
    assert 0.03 < np.abs(wrong).max() <= 0.05


def test_rollouts_do_not_depend_on_their_batch(runner: Runner) -> None:
    def act(force: np.ndarray, _: int) -> np.ndarray:
        return closing(0.03 * (0.9 - force[:, MIDDLE]), force)

    together = played(runner, act)
    back = played(runner, act, SEEDS[::-1])
    alone = played(runner, act, SEEDS[3:4])
    assert together.returns.tobytes() == back.returns[::-1].tobytes()
    assert together.terms[3].tobytes() == alone.terms[0].tobytes()


# ---------------------------------------------------------------- touch


@pytest.mark.slow
def test_feeling_the_force_is_enough_and_closing_blindly_is_not(runner: Runner) -> None:
    felt = played(
        runner, lambda force, _: closing(0.02 * np.clip(0.9 - force[:, MIDDLE], -1.0, 1.0), force)
    )
    blind = [
        played(
            runner, lambda force, t, steps=steps: closing(0.02 if t < steps else 0.0, force)
        ).success.mean()
        for steps in range(2, STEPS, 2)
    ]
    assert felt.success.mean() >= 0.95
    assert max(blind) < 0.75


def test_settings_that_make_no_sense() -> None:
    with pytest.raises(ConfigError, match="unknown state base 'smell'; known are"):
        FragileBarConfig(state="smell")
    with pytest.raises(ConfigError, match="steps is 2; expected 3 to 1000"):
        FragileBarConfig(steps=2)
    with pytest.raises(ConfigError, match="bias"):
        FragileBarConfig(joint_bias=-1.0)


def test_the_force_that_is_allowed_is_shown():
    channels = {channel.name: channel for channel in FragileBar().channels}
    assert channels["contacts/force"].limits == {"middle": WINDOW}
