"""Verifies a run: repeats its generations, and compares every number with those in its folder, to the last bit."""

import hashlib
import itertools
import logging
import math
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from farm import fingerprint
from farm.arrays import FloatArray
from farm.errors import RunError
from farm.net.stats import GenerationStats
from farm.net.work import Jobs, Simulated
from learner.again.replay import restored
from learner.again.rewind import before, pairs_of
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run import hash_chain
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.evaluation import outcome
from learner.run.files import NONE
from learner.run.folder import RunFolder
from learner.run.hash_chain import ChainEntry
from learner.run.launch import Placement, connected, dispatch, open_run
from learner.run.learner import explored
from learner.run.setup import Problem
from learner.scheduler.membership import Admission
from learner.scheduler.round import RoundResults

log = logging.getLogger(__name__)

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
    entries: Mapping[int, ChainEntry]
    """Of chain, by generation."""
    summary: Mapping[str, Any] | None

    @property
    def last(self) -> int:
        """Finished generations."""
        return len(self.lines)

    @property
    def chain(self) -> str:
        """The last digest of its chain, which names all its numbers."""
        return self.at.chain

    @property
    def sha256(self) -> str:
        """Of the final parameters, as in summary.json."""
        numbers = b"".join(np.asarray(self.at.state[name]).astype("<f8").tobytes() for name in ("mu", "sigma"))
        return hashlib.sha256(numbers).hexdigest()


def stored(folder: RunFolder) -> Stored:
    """Read a run, and compare its files with each other, also with its chain of digests.

    Raises:
      ConfigError: the folder has no run that can be simulated here.
      Differs: a generation is missing, or two files say different things about it.
    """
    at = checkpoints.load(folder.checkpoint)
    last, config = int(at.state["generation"]), folder.read_config()
    for name, old, new in configs.other(configs.from_dict(at.config, str(folder.checkpoint)), config):
        raise Differs(f"{folder.path}: generation 1 differs: --{name} is {new} in config.json, and {old} in checkpoint")
    problem = restored(folder, at)
    if at.code.get("simulation") != problem.code["simulation"]:
        log.warning("%s: the simulation's code (farm/) is of another release than when the run began", folder.path)
    lines = {line.generation: line for line in folder.progress() if line.generation <= last}
    table = folder.parameters.rows() if folder.parameters.path.exists() else np.empty(0, [("generation", "<i8")])
    rows = {int(row["generation"]): row for row in table if row["generation"] <= last}
    observation = problem.spec.observation if config.policy_config.normalise else 0
    every = folder.parameters.every(len(at.state["mu"]), config.generations, observation)
    entries, before = folder.chain.read(), hash_chain.first(config, at.config)
    for generation in range(1, last + 1):
        if generation not in lines:
            raise Differs(f"{folder.path}: generation {generation} differs: progress.jsonl has no line of it")
        if generation % every == 0 and generation not in rows:
            raise Differs(f"{folder.path}: generation {generation} differs: parameters has no row of it")
        if generation in rows:
            _agree(folder, generation, lines[generation], _of_parameters(rows[generation]), "parameters")
        before = _linked(folder, generation, before, lines[generation], rows.get(generation), entries)
    if last in rows:
        _agree_bits(folder, last, rows[last], at.state, "checkpoint")
    if last and (before, entries[last].state) != (at.chain, hash_chain.state_of(at)):
        raise Differs(f"{folder.path}: generation {last} differs: checkpoint is not the one that chain says")
    run = Stored(folder, config, at, problem, lines, rows, entries, folder.read_summary())
    if run.summary and (digest := run.summary.get("parameters_sha256")) != run.sha256:
        raise Differs(f"{folder.path}: summary.json says that the parameters are {digest}, they are {run.sha256}")
    return run


def chosen(run: Stored, share: float, rng: np.random.Generator) -> list[int]:
    """A random share of the generations, at least one if there are any."""
    count = min(run.last, max(1, math.ceil(share * run.last)))
    return sorted(int(each) + 1 for each in rng.choice(run.last, count, replace=False))


Simulate: TypeAlias = Callable[[FloatArray, Jobs, FloatArray], Simulated | RoundResults]
"""Results of jobs around a mean (P,), with a RoundHeader's normaliser."""


@contextmanager
def workers(run: Stored, place: Placement | None, stopped: Callable[[], bool]) -> Iterator[Simulate]:
    """What simulates: this process, or workers at that place."""
    with ExitStack() as stack:
        if place is None:
            runner = stack.enter_context(closing(run.problem.runner()))
            yield lambda mu, jobs, normaliser: runner.run(mu, jobs, "none", normaliser)
            return
        link, name = stack.enter_context(connected(place, run.problem, stopped)), f"verify-{secrets.token_hex(4)}"
        admission, count = Admission(fingerprint.digest()), itertools.count()
        dispatcher, _ = dispatch(stack, link, place, run.problem, name, admission, run.last, stopped)

        def simulate(mu: FloatArray, jobs: Jobs, normaliser: FloatArray) -> RoundResults:
            dispatcher.begin(next(count), mu, jobs, normaliser=normaliser)
            return dispatcher.collect()

        yield simulate


def verify_some(run: Stored, generations: Sequence[int], simulate: Simulate) -> Iterator[tuple[int, int]]:
    """Repeat the rollouts of some generations; yield each generation and its number of rollouts.

    Each begins with the stored mean and sigma before it: their update itself is not repeated.

    Raises:
      Differs: a generation has other numbers.
      Stopped: it was asked to stop.
    """
    for generation in generations:
        state, normaliser = before(run.folder, run.at, run.problem, generation)
        jobs = explored(run.config, state, pairs_of(run.folder, generation))[1]
        jobs = Jobs.joined([jobs, Jobs.mean("none", [None])])
        results = simulate(state.mu, jobs, np.stack([normaliser, normaliser]))
        rollouts = len(results.returns) - 1
        _agree(run.folder, generation, run.lines[generation], outcome(run.problem.spec, results, rollouts), "repeated")
        yield generation, rollouts


def verify_all(
    run: Stored, place: Placement, stopped: Callable[[], bool], workspace: Path | None
) -> Iterator[tuple[int, int]]:
    """Learn the run again on workers; yield each generation and its number of rollouts.

    Args:
      run: to repeat.
      place: where the workers are.
      stopped: whether to end before the last generation.
      workspace: folder in which an interrupted repetition is continued; it is removed at the end.

    Raises:
      Differs: a generation has other numbers, or the results have.
    """
    config = replace(run.config, generations=run.last)
    finished = run.summary is not None and run.summary.get("state") == "finished"
    with ExitStack() as stack:
        path = (workspace or Path(stack.enter_context(tempfile.TemporaryDirectory()))) / run.folder.name
        again = stack.enter_context(open_run(config, path, place, resume=path.exists(), stopped=stopped))
        done = again.learner.at.rollouts
        for report in again.learn():
            values = {
                name: value for name, value in vars(report.progress).items() if name not in hash_chain.OF_MACHINES
            }
            _agree(run.folder, report.generation, run.lines[report.generation], values, "repeated")
            if report.generation in run.rows:
                state = again.learner.state
                _agree_bits(
                    run.folder, report.generation, run.rows[report.generation], vars(state), "the repetition"
                )  # fmt: skip
            if hash_chain.state_of(again.learner.at) != run.entries[report.generation].state:
                where = f"{run.folder.path}: generation {report.generation} differs"
                raise Differs(f"{where}: the state after it has another digest in chain")
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
        if workspace is not None and not stopped():
            shutil.rmtree(workspace)


def _linked(
    folder: RunFolder,
    generation: int,
    before: str,
    line: GenerationStats,
    row: Any,  # noqa: ANN401  an array's row, or None
    entries: Mapping[int, ChainEntry],
) -> str:
    """The digest of a generation in chain, if it is that of its line, its row and the generation before it."""
    where = f"{folder.path}: generation {generation} differs"
    if generation not in entries:
        raise Differs(f"{where}: chain has no line of it")
    entry = entries[generation]
    if row is not None:  # of others there is only what chain says
        normaliser = row["normaliser"] if "normaliser" in row.dtype.names else NONE
        if hash_chain.following(before, line, row["mu"], row["sigma"], normaliser, entry.state) != entry.digest:
            raise Differs(f"{where}: progress.jsonl or parameters, or what is before it, have another digest in chain")
    return entry.digest


def _of_parameters(row: Any) -> dict[str, float]:  # noqa: ANN401  an array's row
    mu, sigma = row["mu"], row["sigma"]
    return {
        "mean_norm": float(np.sqrt((mu * mu).sum())),
        "sigma_mean": float(sigma.mean()),
        "sigma_min": float(sigma.min()),
        "sigma_max": float(sigma.max()),
    }


def _agree(folder: RunFolder, generation: int, line: GenerationStats, values: Mapping[str, Any], where: str) -> None:
    for name, value in values.items():
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
