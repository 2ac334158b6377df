"""How a run begins: from another run, at a fitted start; and what workers are told."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, learnt

from farm import plugins, seeds
from farm.errors import ConfigError
from farm.runner import served
from learner.run import checkpoint as checkpoints
from learner.run import pilot, setup
from learner.run.config import configure
from learner.tools.replay.loaded import load

pytestmark = pytest.mark.usefixtures("grips_found_once")


def test_a_run_that_starts_from_another(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, seed=3), tmp_path / "first")
    other = checkpoints.load(tmp_path / "first" / "checkpoint")
    for sigma in ("run", "fresh"):
        config = configure(
            pole, seed=4, init_from=str(tmp_path / "first"), init_sigma=sigma, initial_sigma=0.5
        )
        problem, at = setup.start(config, "second")
        assert at.state["mu"].tobytes() == other.state["mu"].tobytes()
        assert (at.state["sigma"].tobytes() == other.state["sigma"].tobytes()) == (sigma == "run")
        assert at.state["generation"] == 0
        for name, values in other.constants.items():
            assert problem.policy.constants[name].tobytes() == values.tobytes(), (
                "else its parameters mean something else"
            )


def test_a_run_that_goes_on_has_steps_of_the_size_that_the_first_ones_pilot_found(
    pole: str, tmp_path: Path
) -> None:
    clipup: dict[str, Any] = {"optimiser": "clipup"}
    first = replace(configure(pole, **clipup, seed=3), pilot_sigma=0.01)
    learnt(first, tmp_path / "first")
    after: dict[str, Any] = {**clipup, "pilot": True, "init_from": str(tmp_path / "first")}
    heir = pilot.piloted(configure(pole, **after))
    assert heir.pilot_sigma == 0.01
    assert heir.algorithm_of() == first.algorithm_of()
    assert heir.algorithm_of().max_speed < configure(pole, **clipup).algorithm_of().max_speed
    fresh = configure(pole, **after, init_sigma="fresh")
    assert pilot.piloted(fresh).pilot_sigma not in (None, 0.01), "it measures anew"


@pytest.mark.parametrize("algorithm", ["cma-es", "sep-cma", "snes"])
def test_a_run_that_goes_on_explores_as_far_as_the_first_one_did(
    pole: str, tmp_path: Path, algorithm: str
) -> None:
    pytest.importorskip("cmaes")
    learnt(configure(pole, seed=3, algorithm=algorithm), tmp_path / "first")
    before = checkpoints.load(tmp_path / "first" / "checkpoint").state["sigma"]
    config = configure(pole, algorithm=algorithm, init_from=str(tmp_path / "first"))
    problem, at = setup.start(config, "second")
    search = config.algorithm_of()
    state = search.restore(at.state)
    draws = np.concatenate([search.ask(state, np.random.default_rng(i)) for i in range(200)])
    np.testing.assert_allclose(draws.std(axis=0), before, rtol=0.1)
    assert len(before) == problem.policy.size


def test_an_mlp_starts_at_drawn_weights_which_a_run_to_start_from_replaces(
    pole: str, tmp_path: Path
) -> None:
    mlp: dict[str, Any] = {"policy": "mlp", "layers": (3,), "algorithm": "es", "generations": 2}
    config = configure(pole, **mlp)
    problem, at = setup.start(config, "first")
    weights = problem.policy.start(seeds.start(config.seed))
    assert weights is not None
    assert at.state["mu"].tobytes() == weights.tobytes()
    raised = setup.start(configure(pole, **mlp, initial_mu=0.5), "first")[1]
    assert raised.state["mu"].tobytes() == (0.5 + weights).tobytes()
    assert not at.constants, "workers need no start"
    learnt(config, tmp_path / "first")
    assert load(tmp_path / "first", 0).mu.tobytes() == weights.tobytes()
    other = checkpoints.load(tmp_path / "first" / "checkpoint").state["mu"]
    _, heir = setup.start(
        configure(pole, **mlp, seed=4, init_from=str(tmp_path / "first")), "second"
    )
    assert heir.state["mu"].tobytes() == other.tobytes()


def test_a_run_whose_parameters_mean_something_else_is_no_beginning(
    pole: str, tmp_path: Path
) -> None:
    learnt(configure(pole), tmp_path / "first")
    for changed, words in (
        ({"features": 4}, "its parameters mean something else"),
        ({"policy": "cosine"}, r"its parameters mean something else \(direct, not cosine\)"),
    ):
        with pytest.raises(ConfigError, match=words):
            setup.start(configure(pole, init_from=str(tmp_path / "first"), **changed), "second")
    with pytest.raises(ConfigError, match="is not a run's folder"):
        setup.start(configure(pole, init_from=str(tmp_path)), "second")


@pytest.mark.parametrize(("policy", "settings"), [("kernel", {}), ("projected", {"features": 5})])
def test_a_fitted_start(pole: str, policy: str, settings: dict[str, Any]) -> None:
    config = configure(pole, policy=policy, initial_mu=1.5, start="fitted", **settings)
    fit = setup.fitted(config)
    distance = np.hypot(1.5 - 0.2, 1.5)  # qpos and qvel at the start
    width, sigma = fit.policy_config.bandwidth, fit.algorithm_config.initial_sigma  # type: ignore[attr-defined]
    assert distance**2 / (2 * width**2) == pytest.approx(1.0)
    assert 2 * sigma**2 / (2 * width**2) == pytest.approx(1.0)
    assert setup.fitted(fit) == fit, "so that config.json repeats the run"
    state = setup.start(fit, "r")[1].state
    assert (state["mu"] == 1.5).all()
    assert (state["sigma"] == sigma).all()
    printed = replace(config, start="printed")
    assert setup.fitted(printed) is printed


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "--start fitted is for the policies kernel and projected, not direct"),
        (
            {"policy": "kernel", "init_from": "x"},
            "--start fitted and --init-from exclude each other",
        ),
        (
            {"policy": "kernel", "normalise": True},
            "--start fitted and --normalise exclude each other",
        ),
    ],
)
def test_a_start_that_cannot_be_fitted(pole: str, changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        setup.fitted(configure(pole, start="fitted", **changed))


def test_a_fitted_start_begins_beside_the_observation(pole: str, tmp_path: Path) -> None:
    (tmp_path / "pole.py").write_text(POLE.replace("0.2 if rng", "0.0 if rng"))
    with pytest.raises(
        ConfigError, match="--initial-mu is the observation at the start; take another"
    ):
        setup.fitted(configure(pole, policy="kernel", initial_mu=0.0, start="fitted"))


def test_the_finger_gaits_start_fits_every_state_base() -> None:
    sizes = {"joints": 8, "joints+contacts": 17, "tactile": 54, "joints+tactile": 62}
    for state, size in sizes.items():
        fit = setup.fitted(configure(state=state, start="fitted"))
        width = fit.policy_config.bandwidth  # type: ignore[attr-defined]
        policy = setup.start(fit, "r")[0].policy
        assert 0.1 < width < 10.0
        assert fit.algorithm_config.initial_sigma == pytest.approx(width * np.sqrt(2 / size))  # type: ignore[attr-defined]
        assert policy.size == 8 * size


def test_what_workers_are_told_is_the_problem(pole: str, tmp_path: Path) -> None:
    problem, _ = setup.start(configure(pole, mass=2.0), "r")
    spec = problem.specification("r")
    assert (spec.task, problem.files) == ("pole.py:Pole", (tmp_path / "pole.py",))
    task, policy = served(spec, problem.files)
    assert (task.config, task.sources) == (problem.task.config, problem.task.sources)
    assert policy.constants.keys() == problem.policy.constants.keys()
    theta = np.ones((2, policy.size))
    x = np.ones((2, policy.spec.observation))
    assert (
        policy.act(policy.prepare(theta), x).tobytes()
        == problem.policy.act(problem.policy.prepare(theta), x).tobytes()
    )
    assert problem.code["task"] == plugins.find("tasks", pole).digest()
