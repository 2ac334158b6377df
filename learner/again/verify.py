"""Verifies a run: repeats its generations, and compares every number with those in its folder, to the last bit."""

import hashlib
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.errors import RunError
from farm.net.stats import GenerationStats
from farm.net.work import Jobs
from learner.again.replay import restored
from learner.again.rewind import before, pairs_of
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.evaluation import outcome
from learner.run.folder import RunFolder
from learner.run.launch import Placement, open_run
from learner.run.learner import explored
from learner.run.setup import Problem

_OF_MACHINES: Final = ("reissued", "workers", "seconds")  # in a line of progress.jsonl, and in no repetition
_RESULTS: Final = (
    "rollouts", "steps", "best_return", "mean_policy_return", "mean_policy_success", "robust_return",
    "robust_success_rate", "mean_policy_measures", "robust_measures",
)  # fmt: skip


class Differs(RunError):  # noqa: N818  the answer to a question
    """A number of the run is another one when it is repeated, or its files contradict each other."""


@dataclass(frozen=True)
class Stored:
    """What a run's folder says, without contradictions."""

    folder: RunFolder
    config: RunConfig
    at: Checkpoint
    problem: Problem
    lines: Mapping[int, GenerationStats]
    """Of progress.jsonl, by generation."""
    rows: Mapping[int, Any]
    """Of parameters: mu and sigma after those generations that are kept."""
    summary: Mapping[str, Any] | None

    @property
    def last(self) -> int:
        """Finished generations."""
        return len(self.lines)

    @property
    def sha256(self) -> str:
        """Of the final parameters, as in summary.json."""
        numbers = b"".join(np.asarray(self.at.state[name]).astype("<f8").tobytes() for name in ("mu", "sigma"))
        return hashlib.sha256(numbers).hexdigest()


def stored(folder: RunFolder) -> Stored:
    """Read a run, and compare its files with each other.

    Raises:
      ConfigError: the folder has no run that can be simulated here.
      Differs: a generation is missing, or two files say different things about it.
    """
    at = checkpoints.load(folder.checkpoint)
    last, config = int(at.state["generation"]), folder.read_config()
    problem = restored(folder, at)
    lines = {line.generation: line for line in folder.progress() if line.generation <= last}
    kept = folder.parameters.rows() if folder.parameters.path.exists() else np.empty(0, [("generation", "<i8")])
    rows = {int(row["generation"]): row for row in kept if row["generation"] <= last}
    seen = problem.spec.observation if config.policy_config.normalise else 0
    every = folder.parameters.every(len(at.state["mu"]), config.generations, seen)
    for generation in range(1, last + 1):
        if generation not in lines:
            raise Differs(f"{folder.path}: generation {generation} differs: progress.jsonl has no line of it")
        if generation % every == 0 and generation not in rows:
            raise Differs(f"{folder.path}: generation {generation} differs: parameters has no row of it")
        if generation in rows:
            _agree(folder, generation, lines[generation], _of_parameters(rows[generation]), "parameters")
    if last in rows:
        _agree_bits(folder, last, rows[last], at.state, "checkpoint")
    run = Stored(folder, config, at, problem, lines, rows, folder.read_summary())
    if run.summary and (said := run.summary.get("parameters_sha256")) != run.sha256:
        raise Differs(f"{folder.path}: summary.json says that the parameters are {said}, they are {run.sha256}")
    return run


def chosen(run: Stored, share: float, rng: np.random.Generator) -> list[int]:
    """A random share of the generations, at least one if there are any."""
    count = min(run.last, max(1, math.ceil(share * run.last)))
    return sorted(int(each) + 1 for each in rng.choice(run.last, count, replace=False))


def verify_some(run: Stored, generations: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Repeat the rollouts of some generations in this process; yield each generation and its number of rollouts.

    Each begins with the stored mean and sigma before it: their update itself is not repeated.

    Raises:
      Differs: a generation has other numbers.
    """
    for generation in generations:
        state, seen = before(run.folder, run.at, run.problem, generation)
        jobs = explored(run.config, state, pairs_of(run.folder, generation))[1]
        jobs = Jobs.joined([jobs, Jobs.mean("none", [None])])
        with closing(run.problem.runner()) as runner:
            found = runner.run(state.mu, jobs, "none", np.stack([seen, seen]))
        rollouts = len(found.returns) - 1
        _agree(run.folder, generation, run.lines[generation], outcome(run.problem.spec, found, rollouts), "repeated")
        yield generation, rollouts


def verify_all(run: Stored, place: Placement, stopped: Callable[[], bool]) -> Iterator[tuple[int, int]]:
    """Learn the run again on workers; yield each generation and its number of rollouts.

    Raises:
      Differs: a generation has other numbers, or the results have.
    """
    config = replace(run.config, generations=run.last)
    finished = run.summary is not None and run.summary.get("state") == "finished"
    with (
        tempfile.TemporaryDirectory() as folder,
        open_run(config, Path(folder) / run.folder.name, place, stopped=stopped) as again,
    ):
        done = 0
        for report in again.learn():
            given = {name: value for name, value in vars(report.progress).items() if name not in _OF_MACHINES}
            _agree(run.folder, report.generation, run.lines[report.generation], given, "repeated")
            if report.generation in run.rows:
                state = again.learner.state
                _agree_bits(
                    run.folder, report.generation, run.rows[report.generation], vars(state), "the repetition"
                )  # fmt: skip
            yield report.generation, report.progress.rollouts - done
            done = report.progress.rollouts
        if again.summary["state"] == "finished" and finished:
            assert run.summary is not None
            for name in _RESULTS:
                if name in run.summary and run.summary[name] != again.summary.get(name):
                    raise Differs(
                        f"{run.folder.path}: {name} is {run.summary[name]!r} in summary.json, and "
                        f"{again.summary.get(name)!r} when it is repeated"
                    )


def _of_parameters(row: Any) -> dict[str, float]:  # noqa: ANN401  an array's row
    mu, sigma = row["mu"], row["sigma"]
    return {
        "mean_norm": float(np.sqrt((mu * mu).sum())),
        "sigma_mean": float(sigma.mean()),
        "sigma_min": float(sigma.min()),
        "sigma_max": float(sigma.max()),
    }


def _agree(folder: RunFolder, generation: int, line: GenerationStats, given: Mapping[str, Any], where: str) -> None:
    for name, value in given.items():
        if getattr(line, name) != value:
            raise Differs(
                f"{folder.path}: generation {generation} differs: {name} is {getattr(line, name)!r} in "
                f"progress.jsonl, and {value!r} " + ("when it is repeated" if where == "repeated" else f"by {where}")
            )


def _agree_bits(folder: RunFolder, generation: int, row: Any, state: Mapping[str, Any], where: str) -> None:  # noqa: ANN401
    for name in ("mu", "sigma"):
        if np.asarray(state[name]).tobytes() != row[name].tobytes():
            at = int(np.flatnonzero(np.asarray(state[name]) != row[name])[0])
            raise Differs(
                f"{folder.path}: generation {generation} differs: {name}[{at}] is {float(row[name][at])!r} in "
                f"parameters, and {float(state[name][at])!r} in {where}"
            )
