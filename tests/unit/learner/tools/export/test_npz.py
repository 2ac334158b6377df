"""An exported policy, played by the example, gives the return of our own rollout to the last
bit.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from covering import any_two
from robot import robot

from farm.errors import ConfigError
from farm.policies.normalised import Normalised
from farm.tasks.finger_gait.observations import STATES
from learner.run.config import configure
from learner.run.setup import start
from learner.tools.export import npz as export
from learner.tools.replay.loaded import LoadedPolicy

pytestmark = pytest.mark.usefixtures("grips_found_once")

EXAMPLE = Path(__file__).parents[5] / "examples" / "play_policy.py"
SETTINGS: dict[str, dict[str, Any]] = {
    "direct": {"features": 30},
    "projected": {"features": 30},
    "cosine": {"features": 30},
    "direct, single": {"features": 30, "precision": "single"},
    "projected, single": {"features": 30, "precision": "single"},
    "cosine, single": {"features": 30, "precision": "single"},
    "kernel": {},
    "constant": {"pose": "between", "motion": 0.3},
    "linear": {},
    "mlp": {"layers": (5, 3)},
    "rbf": {"centres": 4},
    "weighted-kernel": {},
    "rnn": {"units": 5},
    "cpg": {},
}


def played(path: Path) -> float:
    """What the example says a policy returns."""
    spec = importlib.util.spec_from_file_location("play_policy", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    policy = module.Policy(path)
    policy.reset()
    total, alive, t = 0.0, True, 0
    while alive and t < policy.p["steps"]:
        reward, alive = policy.step()
        total += policy.p["gamma"] ** t * reward
        t += 1
    return float(policy.p["return_scale"] * total)


@pytest.mark.parametrize(
    *any_two(policy=SETTINGS, normalise=(False, True), state=("joints+contacts", "joints+tactile"))
)
def test_the_example_plays_every_policy(
    policy: str, normalise: bool, state: str, tmp_path: Path
) -> None:
    config = configure(
        policy=policy.partition(",")[0], state=state, normalise=normalise, **SETTINGS[policy]
    )
    problem, _ = start(config, "r")
    if normalise:
        normaliser = np.random.default_rng(2).uniform(0.5, 1.0, (2, problem.spec.observation))
        problem = replace(problem, policy=Normalised(problem.policy, normaliser))
    assert_played_alike(
        LoadedPolicy(problem, 0, np.random.default_rng(1).normal(0.3, 0.2, problem.policy.size)),
        tmp_path,
    )


def assert_played_alike(learnt: LoadedPolicy, folder: Path) -> None:
    export.write(folder / "p.npz", learnt)
    assert played(folder / "p.npz") == learnt.rollout().trajectory.value


@pytest.mark.parametrize(
    "settings",
    [
        *({"state": state} for state in STATES),
        {"action": "increment", "clip": False},
        {"action": "absolute", "reward": "basic"},
        {
            "state": "joints+contacts",
            "contacts_scale": 0.5,
            "joints_scale": 2.0,
            "weights": "direct",
        },
        {"policy": "direct", "features": 20, "reward": "limited", "return_scale": 0.3},
    ],
    ids=str,
)
def test_the_example_plays_every_state_and_other_settings(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    problem, _ = start(configure(**settings), "r")
    assert_played_alike(
        LoadedPolicy(problem, 0, np.random.default_rng(1).normal(0.3, 0.2, problem.policy.size)),
        tmp_path,
    )


def test_the_example_ends_where_the_object_is_dropped(tmp_path: Path) -> None:
    problem, _ = start(configure(policy="direct", features=20), "r")
    learnt = LoadedPolicy(
        problem, 0, np.random.default_rng(1).normal(3.0, 0.1, problem.policy.size)
    )
    assert learnt.rollout().rollouts.ended[0]
    assert_played_alike(learnt, tmp_path)


BUILT = """import mujoco
from farm import Task


class Built(Task):
    def compiled(self):
        return mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><body><joint name='j'/><geom size='1'/></body></worldbody>"
            "<actuator><motor joint='j'/></actuator></mujoco>"
        )

    def reward(self, sim, action):
        return sim.qpos[:, 0]
"""


def test_a_refused_export_says_why_and_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    (tmp_path / "built.py").write_text(BUILT)
    problem, _ = start(configure(f"{tmp_path}/built.py:Built"), "r")
    path = tmp_path / "p.npz"
    for before in (None, b"an earlier one"):
        if before is not None:
            path.write_bytes(before)
        with pytest.raises(
            ConfigError, match=r"task Built makes its model by compiled\(\): without mjcf\(\)"
        ):
            export.write(path, LoadedPolicy(problem, 0, np.zeros(problem.policy.size)))
        assert (path.read_bytes() if path.exists() else None) == before
    assert {each.name for each in tmp_path.iterdir()} <= {"built.py", "p.npz"}


def test_a_model_in_files_comes_with_all_of_them(tmp_path: Path) -> None:
    problem, _ = start(configure(f"{robot(tmp_path / 'mine')}:Reach", policy="linear"), "r")
    export.write(tmp_path / "p.npz", LoadedPolicy(problem, 0, np.zeros(problem.policy.size)))
    with np.load(tmp_path / "p.npz", allow_pickle=False) as file:
        files = {
            name.removeprefix("file/"): file[name].tobytes()
            for name in file.files
            if name.startswith("file/")
        }
        main, mjcf = file["model"].item(), file["mjcf"].item()
    assert files[main].decode() == mjcf
    for name, content in files.items():
        place = tmp_path / "elsewhere" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "elsewhere" / main))
    np.testing.assert_array_equal(model.mesh_vert, problem.task.model.mesh_vert)
    assert (model.nhfield, model.ntex) == (1, 1)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"steps": 3}, "exported.*: 'steps' is a part of each exported policy; rename it"),
        ({"file": 3}, "exported.*: 'file' is a part of"),
        ([3], "exported.*: a list; expected arrays by name"),
        ({"goal": object()}, "exported.*: 'goal' is a object; expected an array, number or text"),
    ],
)
def test_what_a_task_adds_has_names_and_values_of_its_own(
    more: Any, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = start(configure(policy="linear"), "r")
    monkeypatch.setattr(type(problem.task), "exported", lambda _: more)
    with pytest.raises(ConfigError, match=line):
        export.write(tmp_path / "p.npz", LoadedPolicy(problem, 0, np.zeros(problem.policy.size)))
    assert not list(tmp_path.iterdir())


def test_constants_of_a_policy_have_names_of_their_own(tmp_path: Path) -> None:
    problem, _ = start(configure(policy="linear"), "r")
    policy = problem.policy
    same = type(policy)(policy.config, policy.spec, {"mu": np.zeros(3)})
    learnt = LoadedPolicy(replace(problem, policy=same), 0, np.zeros(policy.size))
    with pytest.raises(ConfigError, match="the policy's constants: 'mu' is a part of"):
        export.write(tmp_path / "p.npz", learnt)
