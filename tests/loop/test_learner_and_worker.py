"""A learner and workers in one process, over a real Zenoh session on loopback: a task in a file is
learnt.
"""

import json
import logging
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning import learnt, workers

from farm.errors import ConfigError
from farm.net.session import free_endpoint, listen
from learner.pool.placement import Placement
from learner.run import checkpoint as checkpoints
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.launch import learn, open_run
from learner.tools.evaluate.evaluate import evaluate
from learner.tools.replay.loaded import load
from learner.tools.replay.rewind import rewind

TASK = '''
import numpy as np
from farm import Channel, Task

class Cart(Task):
    """Bring a cart to where it should be."""

    xml = """<mujoco><worldbody><body name="cart">
        <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="x" ctrlrange="-2 2"/></actuator></mujoco>"""
    steps, substeps = 20, 5
    channels = (Channel(name="place", kind="scalars", shape=(1,), unit="m", trace=True),)

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.5 if rng is None else rng.uniform(0.3, 0.7)

    def measure(self, sim):
        return {"place": sim.qpos}

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0])
'''
PUSHED = (
    TASK.replace(
        "np.abs(sim.qpos[:, 0])", "np.abs(sim.qpos[:, 0] - sim.mocap_pos[:, 0, 0])"
    ).replace("<worldbody>", '<worldbody><body name="goal" mocap="true"/>')
    + """
    def prepare(self, sim, rngs):
        super().prepare(sim, rngs)
        sim.own["when"] = np.array([7 if rng is None else int(rng.integers(2, 15)) for rng in rngs])

    def act(self, sim, action):
        now = sim.t == sim.own["when"]
        sim.mocap_pos[:, 0, 0] = 0.02 * sim.t
        sim.xfrc_applied[now, 2, 0] = 1.0
        sim.qpos[now, 0] += 0.1
        return super().act(sim, action)
"""
)
"""The same, with a goal that moves, and a push and a jump at a step that is drawn for each rollout.
"""
NOISY = (
    TASK
    + """
    def observe(self, sim):
        return super().observe(sim) + 0.1 * sim.noise(2, "readings")

    def act(self, sim, action):
        return super().act(sim, action + 0.2 * sim.noise(1, "motor", "uniform"))
"""
)
"""The same, with noise in each control step."""
ROBUST = TASK.replace("from farm import", "from farm import Robust,").replace(
    "    steps, substeps",
    """    robust = Robust(
        noise=0.02, bias=0.01, observation_delay=(0.0, 0.03), action_delay=(0.0, 0.03),
        motors=(0.8, 1.2), mass=(0.9, 1.1), payload=(0.0, 0.2), friction=(0.5, 1.5),
        push=(0.0, 2.0), push_duration=0.05, body="cart",
    )
    steps, substeps""",
)
"""The same, with all conditions of `farm.Robust`."""
SMALL: dict[str, Any] = {"generations": 6, "pairs": 6, "initial_sigma": 0.5}


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    path = tmp_path / "mine" / "cart.py"
    path.parent.mkdir()
    path.write_text(TASK)
    return path


def test_a_task_in_a_file_is_learnt_alike_by_any_workers_and_resumed(
    cart: Path, tmp_path: Path
) -> None:
    config = configure(f"{cart}:Cart", **SMALL)
    one, two = (learnt(config, tmp_path / str(count), count, cart) for count in (1, 2))
    assert one["state"] == two["state"] == "finished"
    assert one["parameters_sha256"] == two["parameters_sha256"]
    assert one["best_return"] > -7.0 > -10.0, "standing still returns -10"
    learnt(configure(f"{cart}:Cart", **{**SMALL, "generations": 3}), tmp_path / "half", 1, cart)
    whole = learnt(config, tmp_path / "half", 2, cart, resume=True)
    assert whole["parameters_sha256"] == one["parameters_sha256"]
    policy = load(tmp_path / "half")
    assert policy.rollout().trajectory.value == one["mean_policy_return"]
    assert policy.rollout().trajectory.channels["place"][0, 0] == 0.5


@pytest.mark.slow
def test_pushes_jumps_and_moving_goals_are_the_same_for_any_workers_and_repeated(
    cart: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cart.write_text(PUSHED)
    config = configure(f"{cart}:Cart", **SMALL)
    one = learnt(config, tmp_path / "1", 1, cart)
    two = learnt(config, tmp_path / "2", 2, cart)
    learnt(replace(config, generations=3), tmp_path / "half", 2, cart)
    resumed = learnt(config, tmp_path / "half", 1, cart, resume=True)
    assert one["parameters_sha256"] == two["parameters_sha256"] == resumed["parameters_sha256"]
    assert "gave other numbers" not in caplog.text
    trajectory = load(tmp_path / "half").rollout().trajectory
    assert trajectory.value == one["mean_policy_return"]
    assert np.diff(trajectory.channels["place"][:, 0]).max() > 0.09, "it jumps"
    again = rewind(tmp_path / "half", 4)
    assert again.returns.max() == RunFolder.open(tmp_path / "1").progress()[3].return_max
    assert again.rollout(7).trajectory.value == again.returns[7]


@pytest.mark.slow
@pytest.mark.parametrize("text", [NOISY, ROBUST], ids=["noise", "robust"])
def test_noise_and_conditions_are_the_same_for_any_workers_resumed_and_repeated(
    cart: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    cart.write_text(text)
    config = configure(f"{cart}:Cart", **SMALL)
    runs = [learnt(config, tmp_path / str(count), count, cart) for count in (1, 2, 3)]
    learnt(replace(config, generations=3), tmp_path / "half", 2, cart)
    runs.append(learnt(config, tmp_path / "half", 1, cart, resume=True))
    assert len({run["parameters_sha256"] for run in runs}) == 1
    assert "gave other numbers" not in caplog.text
    again = rewind(tmp_path / "half", 4)
    assert again.returns.max() == RunFolder.open(tmp_path / "1").progress()[3].return_max
    assert [again.rollout(row).trajectory.value for row in (2, 3, 7)] == again.returns[
        [2, 3, 7]
    ].tolist()


@pytest.mark.slow
def test_evolution_strategies_learn_alike_by_any_workers_and_resumed(
    cart: Path, tmp_path: Path
) -> None:
    changed = {
        "algorithm": "es",
        "policy": "linear",
        "pairs": 6,
        "learning_rate_mu": 0.2,
        "generations": 10,
    }
    config = configure(f"{cart}:Cart", **changed)
    one, two = (learnt(config, tmp_path / str(count), count, cart) for count in (1, 2))
    assert one["mean_policy_return"] > -9.73, "full force returns -9.723, standing still -10"
    learnt(replace(config, generations=4), tmp_path / "half", 1, cart)
    whole = learnt(config, tmp_path / "half", 2, cart, resume=True)
    assert one["parameters_sha256"] == two["parameters_sha256"] == whole["parameters_sha256"]


@pytest.mark.slow
def test_a_host_that_lies_by_a_last_bit_changes_nothing(
    cart: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = configure(f"{cart}:Cart", **SMALL)
    honest = learnt(config, tmp_path / "honest", 1, cart)
    shaded = learnt(config, tmp_path / "shaded", 3, cart, liars=1, audit=0.5)
    assert "host w0 gave other numbers than the checker" in caplog.text
    assert shaded["parameters_sha256"] == honest["parameters_sha256"]


@pytest.mark.slow
def test_normalised_observations_are_the_same_for_any_workers_and_after_a_death(
    cart: Path, tmp_path: Path
) -> None:
    config = configure(f"{cart}:Cart", **SMALL, policy="linear", normalise=True)
    runs = [learnt(config, tmp_path / str(count), count, cart) for count in (1, 3)]
    place = Placement(listen=free_endpoint())
    with open_run(config, tmp_path / "death", place) as run, ExitStack() as others:
        mortal = others.enter_context(ExitStack())
        mortal.enter_context(workers(place.listen, 1, cart))
        for report in run.learn():
            if report.progress.generation == 2:
                mortal.close()  # with what it holds, and without a word
                others.enter_context(workers(place.listen, 1, cart))
    half = learnt(replace(config, generations=3), tmp_path / "half", 2, cart)
    resumed = learnt(config, tmp_path / "half", 1, cart, resume=True)
    assert half["parameters_sha256"] != runs[0]["parameters_sha256"]
    every = [*runs, run.summary, resumed]
    assert len({each["parameters_sha256"] for each in every}) == 1
    assert len({(each["mean_policy_return"], each["robust_return"]) for each in every}) == 1
    policy = load(tmp_path / "half")
    assert policy.rollout().trajectory.value == runs[0]["mean_policy_return"]
    assert evaluate(tmp_path / "3")["perturbed"]["return_mean"] == runs[0]["robust_return"]


@pytest.mark.slow
def test_several_episodes_count_alike_for_any_workers_after_a_death_a_lie_and_a_resume(
    cart: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = configure(f"{cart}:Cart", **{**SMALL, "generations": 30}, episodes=3)
    one = learnt(config, tmp_path / "one", 1, cart)
    shaded = learnt(config, tmp_path / "shaded", 3, cart, liars=1, audit=0.5)
    assert "host w0 gave other numbers than the checker" in caplog.text
    place = Placement(listen=free_endpoint())
    with open_run(config, tmp_path / "death", place) as run, ExitStack() as others:
        mortal = others.enter_context(ExitStack())
        mortal.enter_context(workers(place.listen, 1, cart))
        for report in run.learn():
            if report.progress.generation == 2:
                mortal.close()
                others.enter_context(workers(place.listen, 1, cart))
    learnt(replace(config, generations=7), tmp_path / "half", 2, cart)
    resumed = learnt(config, tmp_path / "half", 1, cart, resume=True)
    assert len({each["parameters_sha256"] for each in (one, shaded, run.summary, resumed)}) == 1
    assert (one["rollouts"], one["steps"]) == (30 * 12 * 3, 30 * 12 * 3 * 20)
    again = rewind(tmp_path / "half", 30)
    line = RunFolder.open(tmp_path / "half").progress()[-1]
    assert (len(again.returns), again.returns[again.best(1)[0]]) == (36, line.return_max)
    assert again.rollout(35).trajectory.value == again.returns[35]


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["rnn", "cpg"])
def test_a_policy_with_memory_is_the_same_for_any_workers_and_acts_again(
    cart: Path, tmp_path: Path, policy: str
) -> None:
    config = configure(f"{cart}:Cart", **SMALL, policy=policy, normalise=True)
    one, two = (learnt(config, tmp_path / str(count), count, cart) for count in (1, 2))
    learnt(replace(config, generations=3), tmp_path / "half", 1, cart)
    resumed = learnt(config, tmp_path / "half", 2, cart, resume=True)
    assert one["parameters_sha256"] == two["parameters_sha256"] == resumed["parameters_sha256"]
    loaded, again = load(tmp_path / "half"), rewind(tmp_path / "half", 4)
    assert loaded.rollout().trajectory.value == one["mean_policy_return"]
    assert again.rollout(7).trajectory.value == again.returns[7]
    assert again.returns.max() == RunFolder.open(tmp_path / "1").progress()[3].return_max
    assert evaluate(tmp_path / "2")["perturbed"]["return_mean"] == one["robust_return"]


@pytest.mark.slow
def test_the_average_of_the_last_means_is_judged_kept_and_resumed(
    cart: Path, tmp_path: Path
) -> None:
    # Far from the actuator's limits
    config = configure(f"{cart}:Cart", **SMALL, average=4, learning_rate_mu=0.05)
    whole = learnt(config, tmp_path / "whole", 2, cart)
    learnt(replace(config, generations=3), tmp_path / "half", 1, cart)
    resumed = learnt(config, tmp_path / "half", 2, cart, resume=True)
    alone = learnt(replace(config, average=1), tmp_path / "alone", 1, cart)
    assert whole["parameters_sha256"] == resumed["parameters_sha256"] == alone["parameters_sha256"]
    assert (
        whole["mean_policy_return"] == resumed["mean_policy_return"] != alone["mean_policy_return"]
    )
    assert whole["robust_return"] == resumed["robust_return"] != alone["robust_return"]
    folder = RunFolder.open(tmp_path / "half")
    policy = load(folder.path)
    np.testing.assert_array_equal(policy.mu, np.mean(folder.parameters.rows()["mu"][-4:], axis=0))
    assert policy.rollout().trajectory.value == whole["mean_policy_return"]
    assert evaluate(folder.path)["perturbed"]["return_mean"] == whole["robust_return"]
    assert evaluate(folder.path, average=1)["perturbed"]["return_mean"] == alone["robust_return"]


@pytest.mark.slow
def test_a_fitted_start_is_kept_and_repeated(cart: Path, tmp_path: Path) -> None:
    config = configure(
        f"{cart}:Cart", policy="kernel", start="fitted", initial_mu=1.0, generations=2, pairs=3
    )
    first = learnt(config, tmp_path / "a", 1, cart)
    fit = RunFolder.open(tmp_path / "a").read_config()
    assert fit.policy_config.bandwidth == pytest.approx((1.25 / 2) ** 0.5)  # type: ignore[attr-defined]
    assert fit.algorithm_config.initial_sigma == fit.policy_config.bandwidth  # type: ignore[attr-defined]  # d = 2
    assert learnt(fit, tmp_path / "b", 1, cart)["parameters_sha256"] == first["parameters_sha256"]
    longer = replace(fit, generations=3)
    assert learnt(longer, tmp_path / "a", 1, cart, resume=True)["generations"] == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "seed"), [("tactile", 47), ("joints+tactile", 3), ("joints+tactile", 47)]
)
def test_touch_is_learnt_from_the_fitted_start(state: str, seed: int, tmp_path: Path) -> None:
    assert list(learn(configure(state=state, start="fitted", seed=seed), tmp_path / "r"))
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert (summary["mean_policy_success"], summary["robust_success_rate"] >= 0.95) == (True, True)


def test_a_file_is_served_only_where_it_is_allowed(
    cart: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = tmp_path / "cart.py"
    other.write_text(TASK.replace("np.abs", "2 * np.abs"))
    config = configure(f"{cart}:Cart", **{**SMALL, "generations": 1})
    place = Placement(listen=free_endpoint())
    complete = threading.Event()

    class Both(logging.Handler):
        """Hears both sides."""

        parts: set[str] = set()

        def emit(self, record: logging.LogRecord) -> None:
            self.parts |= {
                part
                for part in (
                    "allow it by --allow-file cart.py",
                    "cart.py differs from the learner's",
                )
                if part in record.getMessage() and "does not serve this run" in record.getMessage()
            }
            if len(self.parts) == 2:
                complete.set()

    handler = Both()
    logging.getLogger().addHandler(handler)
    try:
        with open_run(config, tmp_path / "r", place) as run:
            endpoint = place.listen
            with workers(endpoint, 1), workers(endpoint, 1, other):
                reports = run.learn()
                results: list[Any] = []
                learning = threading.Thread(target=lambda: results.extend(reports))
                learning.start()
                assert complete.wait(30), handler.parts
                with workers(endpoint, 1, cart):
                    learning.join(30)
        assert run.summary["state"] == "finished"
    finally:
        logging.getLogger().removeHandler(handler)


def test_a_run_keeps_what_its_numbers_follow_from(cart: Path, tmp_path: Path) -> None:
    config = configure(f"{cart}:Cart", **{**SMALL, "generations": 1})
    learnt(config, tmp_path / "r", 1, cart)
    folder = RunFolder.open(tmp_path / "r")
    at = checkpoints.load(folder.checkpoint)
    assert set(at.code) == {"task", "policy", "simulation"}
    assert "slide" in at.files["model.xml"]
    cart.write_text(TASK.replace("-np.abs", "-2 * np.abs"))
    with pytest.raises(ConfigError, match="the code of its task has changed since the run began"):
        learnt(configure(f"{cart}:Cart", **SMALL), tmp_path / "r", 1, cart, resume=True)


def test_an_error_in_a_task_of_ones_own_is_named(cart: Path, tmp_path: Path) -> None:
    cart.write_text(TASK.replace("return -np.abs(sim.qpos[:, 0])", "return 1 / 0"))
    with pytest.raises(ZeroDivisionError):
        learnt(configure(f"{cart}:Cart", **SMALL), tmp_path / "r", 1, cart)
    cart.write_text(TASK.replace("import numpy", "import nunpy"))
    with pytest.raises(
        ConfigError, match=r"cart.py cannot be imported: line 2: ModuleNotFoundError"
    ):
        configure(f"{cart}:Cart")


@pytest.mark.slow
@pytest.mark.parametrize("_", range(3))
def test_of_two_learners_of_one_name_that_start_together_one_gives_way(
    cart: Path, tmp_path: Path, _: int
) -> None:
    config = configure(f"{cart}:Cart", **{**SMALL, "generations": 1})
    place = Placement(connect=(free_endpoint(),))
    together, refusal, refused, done = threading.Barrier(2), threading.Event(), [], []

    def begin(folder: Path) -> None:
        together.wait(20)
        try:
            with open_run(config, folder / "same", place) as run:
                done.extend(run.learn())
        except ConfigError as error:
            refused.append((folder, str(error)))
            refusal.set()

    with listen(place.connect[0], "farm"):
        threads = [threading.Thread(target=begin, args=(tmp_path / name,)) for name in "ab"]
        for thread in threads:
            thread.start()
        assert refusal.wait(30)
        with workers(place.connect[0], 1, cart):
            for thread in threads:
                thread.join(30)
    assert len(done) == 1
    ((folder, reason),) = refused
    assert reason == "a learner of run same is on this farm already: choose a different --name"
    assert not (folder / "same").exists()
