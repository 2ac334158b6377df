"""Contents of a run's folder, read for a verification: its files are compared with each other, and
with its chain.
"""

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from farm.errors import RunError
from farm.net.stats import GenerationStats
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run import hash_chain
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.files import NONE
from learner.run.folder import RunFolder
from learner.run.hash_chain import ChainEntry
from learner.run.setup import Problem
from learner.tools.replay.loaded import restored

log = logging.getLogger(__name__)

_OF_EVALUATION: Final = (
    "mean_policy_",
    "robust_",
    "policy_generation",
    "last_validation",
    "without_learning",
)
"""How the names of those results in summary.json begin that are of the evaluation at a run's end.
"""


class Differs(RunError):  # noqa: N818  the answer to a question
    """A number of the run is another one when it is repeated, or its files contradict each
    other.
    """


@dataclass(frozen=True)
class Stored:
    """Contents of a run's folder, without contradictions."""

    folder: RunFolder
    config: RunConfig
    at: Checkpoint
    problem: Problem
    lines: Mapping[int, GenerationStats]
    """Lines of progress.jsonl, by generation."""
    rows: Mapping[int, Any]
    """Rows of parameters: mu and sigma after the generations that are kept."""
    entries: Mapping[int, ChainEntry]
    """Entries of the chain, by generation."""
    summary: Mapping[str, Any] | None
    last: int
    """Finished generations."""

    @property
    def chain(self) -> str:
        """Last digest of the run's chain, which names all its numbers."""
        return self.at.chain

    @property
    def chained(self) -> bool:
        """Whether the run has a chain from its first generation on; runs of earlier releases have
        none.
        """
        return 1 in self.entries or bool(self.at.chain and not self.entries)

    @property
    def facts(self) -> dict[str, Any]:
        """Fields of summary.json that the run's other files know, with their values there."""
        return {
            "seed": self.config.seed,
            "generations": self.last,
            "rollouts": self.at.rollouts,
            "steps": self.at.steps,
            "best_return": self.at.state.get("best"),
            "best_validation": self.at.validated.score if self.at.validated else None,
            "success_rate": self.lines[self.last].success_rate if self.last else None,
            "parameters_sha256": self.sha256,
            "chain": self.chain,
        }

    def not_compared(self, *, evaluated: bool) -> list[str]:
        """Fields of summary.json that nothing was compared with; `evaluated`: the run's evaluation
        was repeated.
        """
        table = self.summary or {}
        results = [name for name in evaluated_in(table) if evaluated or table[name] is None]
        return [name for name in table if name not in self.facts and name not in results]

    @property
    def sha256(self) -> str:
        """SHA-256 of the final parameters, as in summary.json."""
        numbers = b"".join(
            np.asarray(self.at.state[name]).astype("<f8").tobytes() for name in ("mu", "sigma")
        )
        return hashlib.sha256(numbers).hexdigest()


def evaluated_in(summary: Mapping[str, Any]) -> list[str]:
    """Names of the results of the evaluation at a run's end."""
    return [name for name in summary if name.startswith(_OF_EVALUATION)]


def stored(folder: RunFolder) -> Stored:
    """Read a run, and compare its files with each other, also with its chain of digests.

    Raises:
      ConfigError: the folder has no run that can be simulated here.
      Differs: a generation is missing, or two files say different things about it.
    """
    at = checkpoints.load(folder.checkpoint)
    last, config = int(at.state["generation"]), folder.read_config()
    for name, old, new in configs.other(folder.config_of(at), config):
        raise Differs(
            f"{folder.path}: generation 1 differs: --{name} is {new} in config.json, and {old} in"
            " checkpoint"
        )
    problem = restored(folder, at)
    if at.code.get("simulation") != problem.code["simulation"]:
        log.warning(
            "%s: the simulation's code (farm/) is of another release than when the run began",
            folder.path,
        )
    lines = {line.generation: line for line in folder.progress() if line.generation <= last}
    table = (
        folder.parameters.rows()
        if folder.parameters.path.exists()
        else np.empty(0, [("generation", "<i8")])
    )
    rows = {int(row["generation"]): row for row in table if row["generation"] <= last}
    run = Stored(
        folder, config, at, problem, lines, rows, folder.chain.read(), folder.read_summary(), last
    )
    _check_generations(run)
    _check_chain(run)
    _check_summary(run)
    return run


def _check_generations(run: Stored) -> None:
    """Compare progress.jsonl with parameters, and these with the checkpoint."""
    folder = run.folder
    observation = run.problem.spec.observation if run.config.policy_config.normalise else 0
    every = folder.parameters.every(len(run.at.state["mu"]), run.config.generations, observation)
    for generation in range(1, run.last + 1):
        if generation not in run.lines:
            raise Differs(
                f"{folder.path}: generation {generation} differs: progress.jsonl has no line of it"
            )
        if generation % every == 0 and generation not in run.rows:
            raise Differs(
                f"{folder.path}: generation {generation} differs: parameters has no row of it"
            )
        if generation in run.rows:
            agree(
                folder,
                generation,
                run.lines[generation],
                _of_parameters(run.rows[generation]),
                "parameters",
            )


def _check_chain(run: Stored) -> None:
    """Compare every generation with the chain.

    Those before its first line are of an earlier release, without one.
    """
    folder, last = run.folder, run.last
    if run.last and not run.chained:
        where = f"before generation {min(run.entries)}" if run.entries else "at all"
        log.warning(
            "%s: it was learnt by a release without a chain of digests, or its chain was removed:"
            " there is none %s, so that only what is repeated is verified",
            folder.path,
            where,
        )
    first = 1 if run.chained else min(run.entries, default=last + 1)
    before = hash_chain.first(run.config, run.at.config) if first == 1 else ""
    for generation in range(first, last + 1):
        before = _linked(run, generation, before)
    if last in run.rows:
        agree_bits(folder, last, run.rows[last], run.at.state, "checkpoint")
    if first <= last and (before, run.entries[last].state) != (
        run.at.chain,
        hash_chain.state_of(run.at),
    ):
        raise Differs(
            f"{folder.path}: generation {last} differs: checkpoint is not the one that chain says"
        )


def _check_summary(run: Stored) -> None:
    """Compare the results with what the run's other files say."""
    table, path = run.summary, run.folder.path
    if table is None and (path / "summary.json").exists():
        raise Differs(f"{path}: summary.json is damaged: its results cannot be compared")
    for name, value in run.facts.items():
        if table is not None and name in table and table[name] != value:
            raise Differs(
                f"{path}: {name} is {table[name]!r} in summary.json, and {value!r} by the run's"
                " other files"
            )


def _linked(run: Stored, generation: int, before: str) -> str:
    """The digest of a generation in chain, if it is that of its line, its row and the generation
    before it.
    """
    where = f"{run.folder.path}: generation {generation} differs"
    if generation not in run.entries:
        raise Differs(f"{where}: chain has no line of it")
    entry, row = run.entries[generation], run.rows.get(generation)
    if row is not None:  # of others there is only what chain says
        line = run.lines[generation]
        normaliser = row["normaliser"] if "normaliser" in row.dtype.names else NONE
        if (
            hash_chain.following(before, line, row["mu"], row["sigma"], normaliser, entry.state)
            != entry.digest
        ):
            raise Differs(
                f"{where}: progress.jsonl or parameters, or what is before it, have another digest"
                " in chain"
            )
    return entry.digest


def _of_parameters(row: Any) -> dict[str, float]:  # noqa: ANN401  an array's row
    mu, sigma = row["mu"], row["sigma"]
    return {
        "mean_norm": float(np.sqrt((mu * mu).sum())),
        "sigma_mean": float(sigma.mean()),
        "sigma_min": float(sigma.min()),
        "sigma_max": float(sigma.max()),
    }


def agree(
    folder: RunFolder, generation: int, line: GenerationStats, values: Mapping[str, Any], where: str
) -> None:
    """Raise Differs if a generation's line has another value, which it has by `where`."""
    for name, value in values.items():
        if getattr(line, name) != value:
            raise Differs(
                f"{folder.path}: generation {generation} differs: {name} is {getattr(line, name)!r}"
                f" in progress.jsonl, and {value!r} "
                + ("when it is repeated" if where == "repeated" else f"by {where}")
            )


def agree_bits(
    folder: RunFolder,
    generation: int,
    row: Any,  # noqa: ANN401
    state: Mapping[str, Any],
    where: str,
) -> None:
    """Raise Differs if a row of parameters has other bits than a state."""
    for name in ("mu", "sigma"):
        if np.asarray(state[name]).tobytes() != row[name].tobytes():
            at = int(np.flatnonzero(np.asarray(state[name]) != row[name])[0])
            raise Differs(
                f"{folder.path}: generation {generation} differs: {name}[{at}] is"
                f" {float(row[name][at])!r} in parameters, and {float(state[name][at])!r} in"
                f" {where}"
            )
