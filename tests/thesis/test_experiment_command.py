"""`python -m benchmarks.thesis`: experiments with real learners side by side on shared workers, and
their figures.
"""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from processes import Farm, children
from recordings import generations

from benchmarks.thesis.__main__ import main
from benchmarks.thesis.experiment import trial
from benchmarks.thesis.folder import ExperimentFolder
from benchmarks.thesis.setups import SETUPS
from farm.errors import ConfigError
from farm.net.session import free_endpoint
from learner.run import config as configs

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parent.parent.parent

SHORT = ("fig-4.3", "--trials", "2", "--generations", "3", "--workers", "2")
"""Six runs of three generations."""


@pytest.fixture(autouse=True, scope="module")
def from_a_checkout():
    """Commands run in separate folders, and find benchmarks/ by the path."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv(
            "PYTHONPATH",
            os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        )
        yield


def call(farm: Farm, *words: str, status: int = 0, timeout: float = 170) -> str:
    process = start(farm, *words)
    output, _ = process.communicate(timeout=timeout)
    assert process.returncode == status, output
    return output


def start(farm: Farm, *words: str):
    return farm.start_python("-m", "benchmarks.thesis", *words)


def hashes(folder: Path) -> dict[str, str]:
    return {
        path.parent.name: json.loads(path.read_text())["parameters_sha256"]
        for path in (folder / "runs").glob("*/summary.json")
    }


@pytest.fixture
def farm(tmp_path: Path):
    started = Farm(tmp_path)
    yield started
    started.close()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory):
    farm = Farm(tmp_path_factory.mktemp("experiment"))
    farm.output = call(farm, *SHORT, "--out", "side", "--parallel", "3")  # type: ignore[attr-defined]
    yield farm
    farm.close()


@pytest.mark.slow
def test_the_data_is_what_the_runs_recorded(done: Farm) -> None:
    assert "6 of 6 runs to do" in done.output  # type: ignore[attr-defined]
    assert "runs shortened to 3 generations" in done.output  # type: ignore[attr-defined]
    for setup in ("joints-D300-30", "joints-D1500-30", "joints-D8000-30"):
        with np.load(done.folder / "side" / "data" / f"{setup}.npz", allow_pickle=False) as data:
            assert data["states"].tolist() == ["finished", "finished"]
            for number in range(2):
                lines = (
                    done.folder / "side" / "runs" / f"{setup}-s{number}" / "progress.jsonl"
                ).read_text()
                returns = [json.loads(line)["return_mean"] for line in lines.splitlines()]
                assert len(returns) == 3
                assert data["return_mean"][number].tolist() == np.float32(returns).tolist()
    assert (done.folder / "side" / "fig-4.3.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_side_by_side_gives_the_numbers_of_one_after_another(done: Farm) -> None:
    """Each run by itself, with `farm run`: the same bits."""
    for setup, number in (("joints-D300-30", 1), ("joints-D8000-30", 0)):
        plan = done.folder / "plan.json"
        plan.write_text(json.dumps(configs.to_dict(trial(SETUPS[setup], number, 3))))
        done.call(
            "run",
            "--config",
            str(plan),
            "--name",
            f"{setup}-s{number}",
            "--no-record",
            "--workers",
            "1",
        )
        alone = done.summary(f"{setup}-s{number}")["parameters_sha256"]
        assert hashes(done.folder / "side")[f"{setup}-s{number}"] == alone


@pytest.mark.slow
def test_runs_that_are_over_are_not_repeated_and_trials_can_be_added(done: Farm) -> None:
    before = {
        path: path.stat().st_mtime_ns
        for path in (done.folder / "side" / "runs").glob("*/checkpoint")
    }
    assert "0 of 6 runs to do" in call(done, *SHORT, "--out", "side")
    more = ("fig-4.3", "--trials", "3", "--generations", "3", "--out", "side")
    assert "3 of 9 runs to do" in call(done, *more)
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


@pytest.mark.slow
def test_figures_come_from_the_data_alone(done: Farm) -> None:
    shutil.copytree(done.folder / "side", done.folder / "alone")
    shutil.rmtree(done.folder / "alone" / "runs")
    (done.folder / "alone" / "fig-4.3.svg").unlink()
    call(done, "plot", "alone")
    assert (done.folder / "alone" / "fig-4.3.svg").read_bytes() == (
        done.folder / "side" / "fig-4.3.svg"
    ).read_bytes()


def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ExperimentFolder.prepare(tmp_path / "side", ["fig-4.3"], 2, 3)
    for words, reason in (
        (("fig-9",), "unknown experiment 'fig-9'; known are fig-4.1"),
        ((), "which experiment? python -m benchmarks.thesis --list shows them"),
        (
            ("fig-4.5", "--out", str(tmp_path / "side")),
            "side holds fig-4.3: give a different --out",
        ),
        (("fig-4.3", "--workers", "0"), "there would be no workers"),
        (("fig-4.3", "--trials", "0"), "trials is 0; expected 1 to 1000"),
        (("plot", "nowhere"), "nowhere is not an experiment's folder"),
    ):
        with pytest.raises(ConfigError) as line:
            main(words)
        assert reason in str(line.value)
        assert len(str(line.value).splitlines()) == 1
    assert main(("--list",)) == 0
    assert "thesis" in capsys.readouterr().out


@pytest.mark.slow
def test_an_interrupted_experiment_goes_on_to_the_same_numbers(farm: Farm, done: Farm) -> None:
    process = start(farm, *SHORT, "--out", "side")
    farm.wait_for(lambda: list(farm.folder.glob("side/runs/*/progress.jsonl")))
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "runs are left; the same command continues" in output
    call(farm, *SHORT, "--out", "side")
    assert hashes(farm.folder / "side").items() <= hashes(done.folder / "side").items()
    assert len(hashes(farm.folder / "side")) == 6


@pytest.mark.slow
def test_a_killed_experiment_leaves_no_process_behind(farm: Farm) -> None:
    process = start(farm, *SHORT, "--out", "side")
    farm.wait_for(lambda: list(farm.folder.glob("side/runs/*/progress.jsonl")))
    started = children(process.pid)
    assert len(started) > 2
    process.kill()
    process.wait()
    farm.wait_for(
        lambda: not any(Path(f"/proc/{pid}").exists() and not _zombie(pid) for pid in started)
    )


def _zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.slow
def test_a_learner_that_is_killed_is_told_of_and_its_run_done_again(farm: Farm) -> None:
    process = start(farm, *SHORT, "--out", "side", "--parallel", "2")
    farm.wait_for(lambda: list(farm.folder.glob("side/runs/joints-D8000-30-s0/progress.jsonl")))
    learners = [
        pid
        for pid in children(process.pid)
        if b"joints-D8000-30-s0" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    assert len(learners) == 1
    os.kill(learners[0], signal.SIGKILL)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 1, output
    assert "joints-D8000-30-s0 failed" in output
    assert "D 8000: trial 0" in output
    again = call(farm, *SHORT, "--out", "side")
    assert "1 of 6 runs to do" in again
    assert "D 8000: trial 0" not in again


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "measured", "shape"),
    [
        ("chain", "reached", (1, 34)),
        ("fig-4.1", "saturated", (1, 1, 1)),
    ],
)
def test_what_is_measured_on_learnt_policies(
    farm: Farm, name: str, measured: str, shape: tuple[int, ...]
) -> None:
    output = call(farm, name, "--trials", "1", "--generations", "1", "--out", "e", timeout=170)
    assert f"{name}: e/{name}.png and e/{name}.svg" in output
    path = farm.folder / "e" / "data" / f"{name}.npz"
    with np.load(path, allow_pickle=False) as data:
        assert data[measured].shape == shape
        assert ((data[measured] >= 0) & (data[measured] <= 1)).all()
    before = path.stat().st_mtime_ns
    shutil.rmtree(farm.folder / "e" / "runs")
    call(farm, "plot", "e")
    assert path.stat().st_mtime_ns == before
    path.unlink()
    assert "is gone" in call(farm, "plot", "e", status=2)


@pytest.mark.slow
def test_on_the_workers_of_a_farm_encrypted_and_recorded(farm: Farm, done: Farm) -> None:
    endpoint = free_endpoint().replace("tcp", "tls")
    farm.call("certificates", "new", "certs", "--learner", "127.0.0.1", "--worker", "w")
    farm.start_router(endpoint, "--tls", "certs/learner")
    farm.start("worker", "--connect", endpoint, "--tls", "certs/worker-w", "--workers", "1")
    words = ("fig-4.3", "--trials", "1", "--generations", "3", "--out", "side", "--record")
    call(farm, *words, "--connect", endpoint, "--tls", "certs/learner")
    digests = hashes(farm.folder / "side")
    assert len(digests) == 3
    assert digests.items() <= hashes(done.folder / "side").items()
    for name in digests:
        assert generations(farm.folder / "side/runs" / name / "run.rrd") == [1, 2, 3]
