"""`farm export`: a policy in a file gives the same return without this project, and runs
elsewhere.
"""

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from finished import Say, stored
from processes import Farm

from learner.tools.export import npz as export

pytestmark = pytest.mark.usefixtures("grips_found_once")
PLAY_POLICY = Path(__file__).parents[2] / "examples" / "play_policy.py"


def bare(farm: Farm, path: Path) -> str:
    """The example's output, in an interpreter in which importing this project raises."""
    code = (
        "import runpy, sys\n"
        "for package in ('farm', 'learner', 'workers'): sys.modules[package] = None\n"
        f"sys.path.append({str(Path(mujoco.__file__).parents[1])!r})\n"
        f"sys.argv = ['play_policy.py', {str(path)!r}]\n"
        f"runpy.run_path({str(PLAY_POLICY)!r}, run_name='__main__')\n"
    )
    command = [sys.executable, "-I", "-S", "-c", code]
    process = subprocess.run(
        command, cwd=farm.folder, capture_output=True, text=True, timeout=60, check=False
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


def returned(output: str) -> float:
    return float(output.splitlines()[-1].removeprefix("return "))


@pytest.mark.parametrize("name", ["a", "b"])
def test_an_exported_policy_gives_the_same_return_to_the_last_bit(
    done: Farm, say: Say, name: str
) -> None:
    path = done.folder / f"{name}.npz"
    output = say("export", f"runs/{name}", str(path))
    assert f"written to {path}" in output
    with np.load(path, allow_pickle=False) as file:
        assert file["mu"].tobytes() == stored(done, name).mu.tobytes()
        assert "file=" not in str(file["mjcf"])
    assert returned(bare(done, path)) == done.summary(name)["mean_policy_return"]


def test_a_policy_is_exported_for_other_runtimes(done: Farm, say: Say, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    say("export", "runs/a", str(tmp_path / "p.onnx"))
    session = runtime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    loaded = stored(done)
    policy, mu = loaded.problem.policy, loaded.mu
    x = np.full((1, policy.spec.observation), 0.5)
    (action,) = session.run(None, {"observation": x})
    np.testing.assert_allclose(
        action, policy.act(policy.prepare(mu[None]), x), rtol=1e-11, atol=1e-12
    )


@pytest.mark.slow
def test_an_exported_policy_in_an_environment_of_its_own(done: Farm, tmp_path: Path) -> None:
    done.call("export", "runs/a", str(tmp_path / "p.npz"))
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    requirements = [f"{name}=={importlib.metadata.version(name)}" for name in ("mujoco", "numpy")]
    quiet = ("--quiet", "--disable-pip-version-check")
    subprocess.run([python, "-m", "pip", "install", *quiet, *requirements], check=True, timeout=170)
    assert (
        subprocess.run(
            [python, "-E", "-c", "import farm"], cwd=tmp_path, capture_output=True, check=False
        ).returncode
        == 1
    )
    command = [python, "-E", PLAY_POLICY, tmp_path / "p.npz"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    ).stdout
    assert returned(output) == done.summary("a")["mean_policy_return"]


def test_the_exported_numbers_are_plain(done: Farm) -> None:
    values = export.contents(stored(done))
    assert all(np.asarray(value).dtype.kind in "fiU" for value in values.values())
