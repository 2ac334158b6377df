"""Verifies a run: repeats its generations, and compares every number with those in its folder, to
the last bit.
"""

import itertools
import logging
import math
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from farm import fingerprint
from farm.arrays import FloatArray
from farm.net.work import Jobs, Simulated
from learner.pool.admission import Admission
from learner.pool.connection import connected
from learner.pool.placement import Placement
from learner.pool.pool import open_pool
from learner.pool.round import RoundResults
from learner.run import hash_chain
from learner.run.evaluation import outcome, validation, whole_round
from learner.run.launch import open_run
from learner.run.learner import explored
from learner.run.parts import Parts
from learner.tools.replay.rewind import LearntAgain, Simulate, from_row, kept, pairs_of
from learner.tools.verify.stored import Differs, Stored, agree, agree_bits, evaluated_in

log = logging.getLogger(__name__)


def chosen(run: Stored, share: float, rng: np.random.Generator) -> list[int]:
    """A random share of the generations, at least one if there are any.

    They are of those whose state before them is stored, if these are enough: others are repeated by
    learning the run again from its start.
    """
    count = min(run.last, max(1, math.ceil(share * run.last)))
    stored = kept(run.folder, run.at, run.problem)
    choice = stored if count <= len(stored) else range(1, run.last + 1)
    return sorted(int(each) for each in rng.choice(choice, count, replace=False))


@contextmanager
def workers(
    run: Stored, place: Placement | None, stopped: Callable[[], bool]
) -> Iterator[Simulate]:
    """What simulates: this process, or workers at that place."""
    if place is None:
        with closing(run.problem.runner()) as runner:
            yield lambda mu, jobs, normaliser: runner.run(mu, jobs, "none", normaliser)
        return
    name, admission = f"verify-{secrets.token_hex(4)}", Admission(fingerprint.digest())
    with (
        connected(run.problem, place, stopped) as connection,
        open_pool(connection, run.problem, name, admission, generations=run.last) as pool,
    ):
        count = itertools.count()

        def simulate(mu: FloatArray, jobs: Jobs, normaliser: FloatArray) -> RoundResults:
            pool.begin(next(count), mu, jobs, normaliser=normaliser)
            return pool.collect()

        yield simulate


def verify_some(
    run: Stored, generations: Sequence[int], simulate: Simulate
) -> Iterator[tuple[int, int]]:
    """Repeat the rollouts of some generations; yield each generation and its number of rollouts.

    Each begins with the stored mean and sigma before it: their update itself is not repeated. If
    these are not stored, the run is learnt again, once for all such generations.

    Raises:
      Differs: a generation has other numbers.
      Stopped: it was asked to stop.
    """
    stored = {*kept(run.folder, run.at, run.problem)}
    for generation in (each for each in generations if each in stored):
        state, normaliser = from_row(
            run.problem, run.at, run.rows[generation - 1] if generation > 1 else None
        )
        exploring = explored(run.config, state, pairs_of(run.folder, generation))[1]
        parts = whole_round(run.config, generation - 1, exploring)
        results = simulate(state.mu, parts.jobs, np.stack([normaliser, normaliser]))
        yield generation, _repeated(run, generation, parts, results)
    others = {*generations} - stored
    if others:
        message = (
            "%s: the state before generation %d is not stored: learning the run again up to there"
        )
        log.warning(message, run.folder.path, max(others))
    again = LearntAgain(run.folder, run.problem) if others else None
    while again is not None and again.state.generation < max(others):
        parts, results = again.step(simulate)
        generation = int(again.state.generation)
        if generation in others:
            yield generation, _repeated(run, generation, parts, results)


def _repeated(run: Stored, generation: int, parts: Parts, results: Simulated | RoundResults) -> int:
    """The number of exploring rollouts in a repeated generation, whose results are those of the
    run.
    """
    line = run.lines[generation]
    before = run.lines[generation - 1].rollouts if generation > 1 else 0
    rollouts = parts.size("explore")
    here = {
        **outcome(run.problem.spec, results, parts),
        "rollouts": before + rollouts,
        "validation": validation(parts, results.returns),
    }
    agree(run.folder, generation, line, here, "repeated")
    return rollouts


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
    with ExitStack() as stack:
        path = (
            workspace or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ) / run.folder.name
        again = stack.enter_context(
            open_run(config, path, place, resume=path.exists(), stopped=stopped)
        )
        done = again.learner.at.rollouts
        for report in again.learn():
            values = {
                name: value
                for name, value in vars(report.progress).items()
                if name not in hash_chain.OF_MACHINES
            }
            agree(run.folder, report.generation, run.lines[report.generation], values, "repeated")
            if report.generation in run.rows:
                state = again.learner.state
                agree_bits(
                    run.folder,
                    report.generation,
                    run.rows[report.generation],
                    vars(state),
                    "the repetition",
                )
            entry = run.entries.get(report.generation)
            if entry is not None and hash_chain.state_of(again.learner.at) != entry.state:
                where = f"{run.folder.path}: generation {report.generation} differs"
                raise Differs(f"{where}: the state after it has another digest in chain")
            yield report.generation, report.progress.rollouts - done
            done = report.progress.rollouts
        if again.summary["state"] == "finished":
            _agree_results(run, again.summary)
        if workspace is not None and not stopped():
            shutil.rmtree(workspace)


def _agree_results(run: Stored, again: Mapping[str, Any]) -> None:
    """Compare the results of the evaluation; a run that did not reach its end has none."""
    table = run.summary or {}
    for name in evaluated_in(table):
        value = table[name]
        if value != again.get(name) and (value is not None or table.get("state") == "finished"):
            raise Differs(
                f"{run.folder.path}: {name} is {value!r} in summary.json, and {again.get(name)!r}"
                " when it is repeated"
            )
