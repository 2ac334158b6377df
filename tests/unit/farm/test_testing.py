"""Golden rollouts: any number that changes is named, in plain Python and in a pytest of another
folder.
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from alone import POLE

import farm
from farm import plugins
from farm.testing import same

TEST = """
from pole import Pole

def test_the_pole_moves_as_before(golden):
    golden(Pole, "linear", [None, 0, 1], "kept/pole.npz")
"""
PAGE = (Path(__file__).parents[3] / "docs/extending.md").read_text("utf-8")


@pytest.fixture
def pole(tmp_path: Path) -> str:
    (tmp_path / "pole.py").write_text(POLE)
    return f"{tmp_path / 'pole.py'}:Pole"


def changed(pole: str, old: str, new: str) -> str:
    path = Path(pole.rpartition(":")[0])
    assert old in POLE
    path.write_text(POLE.replace(old, new))
    return pole


def by_hand(x: np.ndarray) -> np.ndarray:
    return -0.5 * x[:, :1]


@pytest.mark.parametrize("policy", ["linear", "kernel", "rnn", by_hand])
def test_the_same_rollouts_pass_and_make_the_same_file(
    tmp_path: Path, pole: str, policy: object
) -> None:
    same(pole, policy, [None, 3], tmp_path / "a.npz", update=True)
    same(pole, policy, [None, 3], tmp_path / "a.npz")
    same(plugins.find("tasks", pole).target, policy, [None, 3], tmp_path / "b.npz", update=True)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            'damping="0.1"',
            'damping="0.2"',
            r"rollout 0, control step 1: state/qpos\[0\] was .*; 3 of 3 rollouts",
        ),
        (
            "0.2 if rng is None",
            "0.1 if rng is None",
            r"rollout 0, start: state/qpos\[0\] was 0\.2, is 0\.1; 1 of 3",
        ),
        (
            "-0.3, 0.3",
            "-0.3, 0.4",
            r"rollout 1, start: state/qpos\[0\] was .*; 2 of 3 rollouts differ",
        ),
        (
            "return -np.abs",
            "return -1e-16 - np.abs",
            r"rollout \d, control step 1: reward/reward was -",
        ),
        (
            "return sim.qpos[:, 0] > -9.0",
            "return sim.qpos[:, 0] > 9.0",
            "rollout 0: success was True, is False",
        ),
        (
            "steps = 4",
            "steps = 5",
            r"state/qpos has shape \(3, 6, 1\) of float64; it had \(3, 5, 1\)",
        ),
        (
            'return {"angle": sim.qpos}',
            'return {"angle": sim.qpos, "b": sim.qvel}',
            "the arrays are .*state/b",
        ),
    ],
)
def test_what_changed_is_named_with_its_first_step(
    tmp_path: Path, pole: str, old: str, new: str, line: str
) -> None:
    same(pole, "linear", [None, 0, 1], tmp_path / "a.npz", update=True)
    changed(pole, old, new)
    with pytest.raises(AssertionError, match=line):
        same(pole, "linear", [None, 0, 1], tmp_path / "a.npz")
    same(pole, "linear", [None, 0, 1], tmp_path / "a.npz", update=True)
    same(pole, "linear", [None, 0, 1], tmp_path / "a.npz")


@pytest.mark.slow
def test_a_learnt_policy_acts_as_it_did(tmp_path: Path, pole: str) -> None:
    for _ in farm.learn(
        farm.configure(pole, generations=1, normalise=True), tmp_path / "r", workers=1
    ):
        pass
    policy = farm.load(tmp_path / "r")
    same(pole, policy, [0], tmp_path / "a.npz", update=True)
    with np.load(tmp_path / "a.npz") as archive:
        [trial] = policy.runner.rollouts(policy.mu[None], [(4, 0, 0, 0)]).returns
        assert archive["return"].tolist() == [trial]
    same(pole, policy, [0], tmp_path / "a.npz")


def test_another_release_is_named(
    tmp_path: Path, pole: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as other:
        other.setattr("farm.testing.version", lambda _: "1.2.3")
        same(pole, "linear", [0], tmp_path / "a.npz", update=True)
    same(pole, "linear", [0], tmp_path / "a.npz")  # the numbers count, not the release
    changed(pole, 'damping="0.1"', 'damping="0.2"')
    with pytest.raises(AssertionError, match=r"written with mujoco 1\.2\.3, here "):
        same(pole, "linear", [0], tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("starts", "policy", "line"),
    [
        ([], "linear", "there are no seeds"),
        ([-1], "linear", "seed '-1'; expected a whole number"),
        ([0], 7, "policy is a int; expected that of farm.load, a function, or a name"),
        ([0], "linaer", "unknown policy 'linaer'"),
        ([0], "linear", "no file .*none.npz: update=True"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, pole: str, starts: list[int], policy: object, line: str
) -> None:
    with pytest.raises(farm.ConfigError, match=line):
        same(pole, policy, starts, tmp_path / "none.npz", update=not line.startswith("no file"))


def test_a_damaged_file_is_named(tmp_path: Path, pole: str) -> None:
    (tmp_path / "a.npz").write_bytes(b"PK damaged")
    with pytest.raises(farm.ConfigError, match=r"a\.npz is no file of golden rollouts"):
        same(pole, "linear", [0], tmp_path / "a.npz")


def test_pytest_is_imported_by_the_plugin_alone() -> None:
    code = "import sys, farm.testing; sys.exit('pytest' in sys.modules)"
    assert subprocess.run([sys.executable, "-P", "-c", code], check=False).returncode == 0


def plain_pytest(folder: Path, *words: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    process = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    return process.returncode, process.stdout + process.stderr


@pytest.mark.slow
def test_a_plain_pytest_elsewhere_has_the_fixture(tmp_path: Path, pole: str) -> None:
    (tmp_path / "test_pole.py").write_text(TEST)
    status, output = plain_pytest(tmp_path)
    assert (status, "pytest --golden-update" in output) == (1, True)
    assert plain_pytest(tmp_path, "--golden-update")[0] == 0
    assert (tmp_path / "kept/pole.npz").stat().st_size < 10_000
    assert plain_pytest(tmp_path)[0] == 0
    changed(pole, 'damping="0.1"', 'damping="0.2"')
    status, output = plain_pytest(tmp_path)
    assert status == 1
    assert re.search(r"rollout 0, control step 1: state/qpos\[0\] was", output)
    assert "farm/testing.py" not in output, "the reader's own line is shown, not ours"


@pytest.mark.slow
def test_the_example_of_the_page(tmp_path: Path) -> None:
    [text] = re.findall(r"`pendulum_test\.py`:\n\n```python\n(.*?)```", PAGE, re.S)
    (tmp_path / "pendulum_test.py").write_text(text)
    subprocess.run(
        [sys.executable, "-P", "-m", "farm", "new-task", "pendulum"], cwd=tmp_path, check=True
    )
    assert plain_pytest(tmp_path, "--golden-update")[0] == 0
    assert plain_pytest(tmp_path)[0] == 0
    assert (tmp_path / "pendulum.npz").stat().st_size < 10_000
