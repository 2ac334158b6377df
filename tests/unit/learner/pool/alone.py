"""A small task in a file, and runs of it without a network."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from farm.net.telemetry import Report
from farm.net.work import NOT_NORMALISED, Jobs, Results
from learner.pool.round import RoundResults
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.learner import Learner

POLE = """
from dataclasses import dataclass
from typing import Any, ClassVar
import numpy as np
import farm

MODEL = '''<mujoco><option timestep="0.02"/><worldbody><body>
    <joint name="j" axis="0 1 0" damping="0.1"/>
  <geom size="0.1" mass="MASS"/></body></worldbody><actuator>
      <motor joint="j"/></actuator></mujoco>'''

class Pole(farm.Task):
    presets: ClassVar = {"default": {"features": 3, "pairs": 4, "generations": 3}}
    steps = 4
    channels = (farm.Channel(name="angle", kind="scalars", shape=(1,), trace=True),)

    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        mass: float = farm.setting(1.0, above=0.0)

    def files(self):
        return {"model.xml": MODEL, "note": "read by nobody"}

    def mjcf(self):
        return self.sources["model.xml"].replace("MASS", str(self.config.mass))

    def reset(self, sim, row, rng):
        sim.qpos[row, 0] = 0.2 if rng is None else rng.uniform(-0.3, 0.3)

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0])

    def success(self, sim):
        return sim.qpos[:, 0] > -9.0

    def measure(self, sim):
        return {"angle": sim.qpos}
"""


class Alone:
    """Instead of the pool: does a round's jobs at once, several together, in any order."""

    def __init__(self, problem: setup.Problem, seed: int = 0) -> None:
        self.admission = SimpleNamespace(fingerprint="c", expelled={})
        self.workers, self.worker_pids = ("w/1",), [1]
        self.reissued = 0
        self.hosts = ["w"]
        self.problem = problem
        self._runner = problem.runner()
        self._rng = np.random.default_rng(seed)
        self.rounds: list[tuple[int, Jobs, str]] = []
        self.normalisers: list[np.ndarray] = []

    def begin(
        self,
        generation: int,
        mu: np.ndarray,
        jobs: Jobs,
        traces: str = "none",
        normaliser: np.ndarray = NOT_NORMALISED,
    ) -> None:
        self.rounds.append((generation, jobs, traces))
        self.normalisers.append(normaliser)
        self._round = RoundResults(
            jobs, traces, self.problem.shapes(), observed=normaliser.shape[-1] > 0
        )
        for indices in np.array_split(self._rng.permutation(len(jobs)), 3):
            part = jobs.take(sorted(indices.tolist()))
            simulated = self._runner.run(mu, part, traces, normaliser)
            results = Results.carrying(
                simulated, part, 0.0, run="r", incarnation="i", round=0, worker="w/1"
            )
            place = self._round.place(results)
            assert place is not None
            self._round.put(results, place, np.ones(len(part), bool))

    def returns(self, theta: np.ndarray, seeds: list[tuple[int, ...] | None]) -> np.ndarray:
        """Returns of parameters (S, P) on the starts for these seeds, (S,)."""
        return self._runner.rollouts(theta, seeds).returns

    def progress(self, *, checked: bool = False) -> Iterator[RoundResults]:
        yield self._round

    checks: ClassVar[dict[str, int]] = {"w": 1}

    def stopped(self) -> bool:
        return False

    def collect(self) -> RoundResults:
        return self._round

    def report(self, progress: object) -> None:
        pass


def new_run(config: RunConfig, path: Path) -> tuple[Learner, Alone]:
    problem, at = setup.start(config, path.name)
    return Learner(problem, RunFolder.create(path, config), at), Alone(problem)


def learnt(config: RunConfig, path: Path) -> list[Report]:
    learner, alone = new_run(config, path)
    return list(learner.learn(alone))  # type: ignore[arg-type]


def taken_up(path: Path, *, any_rounding: bool = False, **changed: Any) -> tuple[Learner, Alone]:
    folder = RunFolder.open(path)
    config = replace(folder.read_config(), **changed)
    problem, at = setup.resumed(folder, config, any_rounding=any_rounding)
    folder.truncate(at)
    folder.write_config(config)
    return Learner(problem, folder, at), Alone(problem, 1)


def state(path: Path) -> tuple[bytes, bytes]:
    at = checkpoints.load(path / "checkpoint")
    return at.state["mu"].tobytes(), at.state["sigma"].tobytes()
