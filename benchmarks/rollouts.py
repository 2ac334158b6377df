"""How fast the farm simulates, against bare physics; one table.

    python benchmarks/rollouts.py [--generations 20]

(a) mujoco.batch alone, open loop, all threads; (b) the closed loop (policy, touch, reward) in one
process with as many threads; (c) the farm with two workers over Zenoh. All rows simulate the same
thing: the hand holds the bar still (mu far from every state, no learning), so that no rollout ends
early and all take the same number of physics steps: with perturbations 100 to close the grip for a
pair and 150 a rollout. What is compared are physics steps a second.
"""

import argparse
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np

from farm.net.session import free_endpoint
from farm.rollouts import Runner
from farm.sim.engines import BatchEngine
from farm.tasks.finger_gait.task import CLOSING, SUBSTEPS
from farm.tasks.loop import Batch, Seed, again
from learner.config import RunConfig, configure
from learner.run import Placement, Run, open_run
from learner.setup import problem
from learner.telemetry.report import Report

STILL = 50.0  # every parameter: so far from any joint position that the kernel is zero


@dataclass(frozen=True)
class Measured:
    """A row of the table."""

    steps_per_second: float
    rollouts_per_second: float
    cpu_per_rollout: float


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} cores, {platform.machine()}, Python {platform.python_version()}, MuJoCo {mujoco.__version__}")
    print("\n| preset | what | rollouts/s | CPU ms a rollout | against (a) |\n|---|---|---|---|---|")
    for name in ("default", "thesis"):
        _preset(name, cores, arguments.generations, arguments.repeats)


def _preset(name: str, cores: int, generations: int, repeats: int) -> None:
    config = configure(preset=name)
    closed_loop = _ClosedLoop(config, cores)
    rows: list[tuple[str, Callable[[], Measured]]] = [
        (f"(a) physics alone, {cores} threads", closed_loop.physics),
        (f"(b) closed loop, one process, {cores} threads", closed_loop.run),
        ("(c) farm, 2 workers, N 15", lambda: _farm(config, 15, generations * 4)),
        ("(c) farm, 2 workers, N 100", lambda: _farm(config, 100, generations)),
    ]
    # In turn, several times: what else the machine does then meets every row alike.
    measured = [[run() for _, run in rows] for _ in range(repeats)]
    for i, (what, _) in enumerate(rows):
        ratio = float(np.median([turn[i].steps_per_second / turn[0].steps_per_second for turn in measured]))
        rate = float(np.median([turn[i].rollouts_per_second for turn in measured]))
        cpu = float(np.median([turn[i].cpu_per_rollout for turn in measured]))
        print(f"| {name} ({config.policy}) | {what} | {rate:.0f} | {1e3 * cpu:.2f} | {ratio:.2f} |", flush=True)


class _ClosedLoop:
    """A hundred pairs in one process."""

    def __init__(self, config: RunConfig, cores: int) -> None:
        found = problem(config)
        self._runner = Runner(found.task, found.policy, lambda model: BatchEngine(model, 200, cores))
        self._theta = np.full((200, found.policy.size), STILL)
        self._seeds: list[Seed] = [(i,) if config.task_config.perturb else None for i in range(100) for _ in range(2)]
        self._steps = 200 * found.task.steps * SUBSTEPS + len(set(self._seeds)) * CLOSING
        self._cores = cores

    def run(self) -> Measured:
        """The closed loop."""
        return self._timed(lambda: self._runner.rollouts(self._theta, self._seeds))

    def physics(self) -> Measured:
        """As many physics steps from the same start, all in one call."""
        sim = self._runner.sim
        again(lambda: Batch(self._runner.task, sim, self._seeds))
        bare = mujoco.batch.Batch(sim.model, 200, self._cores)
        for name in ("qpos", "qvel", "ctrl", "eq_active", "mocap_pos", "mocap_quat"):
            bare.bind(name)[:] = getattr(sim, name)
        return self._timed(lambda: bare.step(nstep=self._steps // 200))

    def _timed(self, work: Callable[[], object]) -> Measured:
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return Measured(self._steps / wall, 200 / wall, cpu / 200)


def _farm(config: RunConfig, pairs: int, generations: int) -> Measured:
    """Generations of a run that learns nothing, timed from the second on."""
    still = replace(
        config.algorithm_config,
        pairs=pairs,
        initial_mu=STILL,
        initial_sigma=1e-3,
        learning_rate_mu=0.0,
        learning_rate_sigma=0.0,
    )
    config = replace(config, algorithm_config=still, generations=generations)
    with tempfile.TemporaryDirectory() as folder:
        place = Placement(workers=2, listen=free_endpoint(), record=False)
        with open_run(config, Path(folder) / "run", place) as run:
            wall, own, theirs, done = _generations(run)
    closing = pairs * CLOSING if config.task_config.perturb else 0
    steps = (2 * pairs + 1) * run.learner.problem.task.steps * SUBSTEPS + closing
    return Measured(steps * done / wall, (2 * pairs + 1) * done / wall, (own + theirs) / done / (2 * pairs + 1))


def _generations(run: Run) -> tuple[float, float, float, int]:
    """Wall time, CPU time of this process and of the workers, and how many generations that was."""
    begun: tuple[float, float, float] | None = None
    last: Report | None = None
    for report in run.learn():
        last = report
        now = time.perf_counter(), time.process_time(), _workers_cpu(run)
        if begun is None:
            begun = now
            first = report
        end = now
    assert begun is not None
    assert last is not None
    wall, own, theirs = (b - a for a, b in zip(begun, end, strict=True))
    return wall, own, theirs, last.progress.generation - first.progress.generation


def _workers_cpu(run: Run) -> float:
    tick = os.sysconf("SC_CLK_TCK")
    fields = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in run.worker_pids]
    return sum(int(f[11]) + int(f[12]) for f in fields) / tick


if __name__ == "__main__":
    main()
