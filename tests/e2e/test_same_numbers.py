"""The learnt numbers are the same to the last bit, even if workers die or join late."""

import json
import os
import platform
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from processes import SMALL, Farm, children

from farm.net.session import free_endpoint
from farm.sim.scene import MODEL
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import configure
from learner.run.launch import learn, open_run
from learner.tools.replay.rewind import rewind

pytestmark = pytest.mark.slow

CONFIG = configure(generations=10, pairs=6)


def test_any_number_of_workers(farm: Farm, reference: dict[str, Any]) -> None:
    farm.call("run", "--name", "r", "--generations", "10", "--workers", "3", *SMALL)
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]
    assert farm.summary("r")["workers"] == 3


@pytest.mark.parametrize("seconds", [1e-6, 10.0])
def test_any_size_of_chunk(tmp_path: Path, reference: dict[str, Any], seconds: float) -> None:
    chunks = SchedulerConfig(chunk_seconds=seconds)
    place = Placement(workers=2, listen=free_endpoint(), scheduler=chunks)
    with open_run(CONFIG, tmp_path / "r", place) as run:
        for _ in run.learn():
            pass
    assert run.summary["parameters_sha256"] == reference["parameters_sha256"]


def test_from_python(tmp_path: Path) -> None:
    reports = list(learn(CONFIG, tmp_path / "r"))
    assert [report.progress.generation for report in reports] == list(range(1, 11))
    assert reports[-1].progress.mean_policy_return == reports[-1].sample.value  # type: ignore[union-attr]


def test_a_worker_killed_in_the_middle(farm: Farm, reference: dict[str, Any]) -> None:
    process = farm.start("run", "--name", "r", "--generations", "10", *SMALL)
    farm.wait_for(lambda: len(farm.progress("r")) >= 2)
    for pid in children(process.pid)[:1]:
        os.kill(pid, signal.SIGKILL)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "starting another" in output
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]


def test_interrupted_and_resumed(farm: Farm, reference: dict[str, Any]) -> None:
    process = farm.start("run", "--name", "r", "--generations", "10", *SMALL)
    farm.wait_for(lambda: len(farm.progress("r")) >= 3)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=10)
    assert process.returncode == 130, output
    assert "continue with: farm run --resume" in output
    assert farm.summary("r")["state"] == "interrupted"
    assert children(process.pid) == []
    farm.call("run", "--resume", "runs/r", "--no-record")
    summary = farm.summary("r")
    assert summary["parameters_sha256"] == reference["parameters_sha256"]
    assert summary["robust_success_rate"] == reference["robust_success_rate"]
    assert [line["generation"] for line in farm.progress("r")] == list(range(1, 11))


def test_killed_and_resumed(farm: Farm, reference: dict[str, Any]) -> None:
    process = farm.start("run", "--name", "r", "--generations", "10", *SMALL)
    farm.wait_for(lambda: len(farm.progress("r")) >= 3)
    workers = children(process.pid)
    process.kill()
    process.communicate(timeout=10)
    farm.wait_for(lambda: not any(Path(f"/proc/{pid}/stat").exists() for pid in workers), 10)
    farm.call("run", "--resume", "runs/r", "--no-record", "--workers", "1")
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]
    assert [line["generation"] for line in farm.progress("r")] == list(range(1, 11))


def test_several_objects(farm: Farm) -> None:
    """Spot checks, an evaluation by object and rollouts repeated from their seeds agree with the
    run.
    """
    several = ("--object", "bar", "--object", "bolt", "--generations", "3", *SMALL)
    for count in "13":
        farm.call("run", "--name", f"w{count}", "--workers", count, *several)
    assert farm.summary("w1")["parameters_sha256"] == farm.summary("w3")["parameters_sha256"]
    again = rewind(farm.folder / "runs/w1", 2)
    assert set(again.rollouts.which.tolist()) == {0, 1}
    assert again.returns.mean() == pytest.approx(farm.progress("w1")[1]["return_mean"], rel=1e-12)
    for index, which in enumerate(again.rollouts.which.tolist()):
        trajectory = again.rollout(index).trajectory
        assert trajectory.value == again.returns[index]
        assert trajectory.channels[MODEL].argmax(axis=1).tolist() == [which] * len(trajectory.times)
    results = json.loads(farm.call("evaluate", "runs/w1", "--json"))
    assert (
        sum(row["rollouts"] for row in results["models"].values())
        == results["perturbed"]["rollouts"]
        == 100
    )
    assert results["models"].keys() == {"bar", "bolt"}
    assert "return" in farm.call("replay", "runs/w1", "--object", "cylinder")


def test_repeated_from_its_configuration(farm: Farm) -> None:
    farm.call("run", "--name", "a", "--generations", "2", "--seed", "5", *SMALL)
    farm.call("run", "--name", "b", "--config", "runs/a/config.json", "--no-record")
    farm.call("run", "--name", "c", "--config", "runs/a/config.json", "--seed", "6", "--no-record")
    first, second, third = (farm.summary(run)["parameters_sha256"] for run in "abc")
    assert first == second != third


def test_learner_and_workers_apart(farm: Farm, reference: dict[str, Any]) -> None:
    endpoint = free_endpoint()
    learner = farm.start(
        "learner", "--name", "r", "--generations", "10", "--listen", endpoint, *SMALL
    )
    farm.start("worker", "--connect", endpoint, "--workers", "2")
    output, _ = learner.communicate(timeout=120)
    assert learner.returncode == 0, output
    assert f"workers join with: farm worker --connect {endpoint}" in output
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]


# Names of several releases
_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL"

PROCESSORS = {
    "before AVX2": {
        "NPY_DISABLE_CPU_FEATURES": f"{_AVX512} X86_V3 AVX2 FMA3",
        "OPENBLAS_CORETYPE": "Prescott",
    },
    "with AVX2": {"NPY_DISABLE_CPU_FEATURES": _AVX512, "OPENBLAS_CORETYPE": "Haswell"},
    "BLAS with AVX-512": {"OPENBLAS_CORETYPE": "SkylakeX"},
}
"""Environments in which numpy and its linear algebra compute as they do on other x86-64 processors.
"""

SETTINGS: dict[str, dict[str, Any]] = {
    "kernel": {"generations": 6},
    "projected": {"policy": "projected", "features": 500, "state": "joints+tactile"},
    "single": {"policy": "projected", "features": 500, "precision": "single"},
    "cosine": {"policy": "cosine", "features": 100, "optimiser": "adam", "perturb": True},
    "mlp": {"policy": "mlp", "normalise": True, "state": "joints+contacts"},
    "rbf": {"policy": "rbf", "normalise": True},
    "weighted-kernel": {"policy": "weighted-kernel", "state": "joints+tactile"},
    "rnn": {"policy": "rnn", "normalise": True, "episodes": 2, "perturb": True},
    "cpg": {"policy": "cpg"},
    "fitted": {"start": "fitted", "state": "tactile"},
    "snes": {"generations": 4, "policy": "weighted-kernel", "algorithm": "snes"},
    "ars": {"generations": 4, "policy": "linear", "algorithm": "ars", "normalise": True},
}

LEARN = """
import json, sys
from pathlib import Path
from learner.run.config import configure
from learner.pool.placement import Placement
from learner.run.launch import open_run
place, found = Placement(connect=(sys.argv[1],)), {}
for name, values in json.loads(sys.argv[2]).items():
    with open_run(configure(**{"generations": 3, "pairs": 6, **values}), Path(name), place) as run:
        for _ in run.learn():
            pass
    found[name] = run.summary["parameters_sha256"]
print(json.dumps(found))
"""
"""A learner process that does all these runs, one after another, with the workers at a router."""


def learnt(farm: Farm, variables: dict[str, str]) -> dict[str, str]:
    """The hash of every run's numbers, with learner and workers in this environment."""
    endpoint = free_endpoint()
    with pytest.MonkeyPatch.context() as environment:
        # numpy's, that a processor has no such features anyway
        environment.setenv("PYTHONWARNINGS", "ignore")
        for name, value in variables.items():
            environment.setenv(name, value)
        farm.start_router(endpoint)
        farm.start("worker", "--connect", endpoint, "--workers", "2")
        learner = farm.start_python("-P", "-c", LEARN, endpoint, json.dumps(SETTINGS))
    output, _ = learner.communicate(timeout=150)
    assert learner.returncode == 0, output
    return json.loads(output.splitlines()[-1])


@pytest.fixture(scope="module")
def as_it_is(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The hashes on this processor."""
    with closing(Farm(tmp_path_factory.mktemp("processor"))) as farm:
        return learnt(farm, {})


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the variables are of x86-64")
@pytest.mark.parametrize("processor", PROCESSORS)
def test_any_processor(farm: Farm, as_it_is: dict[str, str], processor: str) -> None:
    assert learnt(farm, PROCESSORS[processor]) == as_it_is
    assert len(set(as_it_is.values())) == len(SETTINGS)
