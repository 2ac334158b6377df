"""The learning loop: ask for samples, simulate, tell the results, save, and report."""

import errno
import hashlib
import itertools
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import CheckpointError, RunError
from farm.moments import merged, normaliser
from farm.net.messages import Spec
from farm.net.stats import GenerationStats
from farm.net.work import Jobs
from farm.tasks.base import Task
from learner import algorithms
from learner import config as configs
from learner.algorithms import Algorithm, SearchState
from learner.checkpoint import BestRollout, Checkpoint
from learner.config import RunConfig
from learner.evaluation import EVALUATION_ROLLOUTS, EVALUATION_SEED, Evaluation, Nominal, evaluation_jobs
from learner.run_folder import RunFolder
from learner.scheduler.dispatcher import Dispatcher
from learner.scheduler.round import RoundResults
from learner.setup import Problem
from learner.telemetry.report import Report

log = logging.getLogger(__name__)

REPLAY_EVERY: Final = 10
"""Generations between two recordings of the best rollout at physics rate: late in a run, most have a new best."""


DURABLE_EVERY: Final = 1.0
"""Time between two checkpoints that survive a power failure [s]; the others survive a killed learner only."""

_FULL: Final = (errno.ENOSPC, errno.EDQUOT)  # full disk, or the user's quota


class Learner:
    """One run, from its start or its checkpoint to its end."""

    def __init__(self, problem: Problem, folder: RunFolder, at: Checkpoint) -> None:
        """Continue a run from its checkpoint; a new run has that of `start`.

        Raises:
          CheckpointError: the checkpoint does not fit the configuration.
        """
        # The best rollout is reported again: the process that ends the run writes a new replay.rrd.
        self.problem, self.config, self.folder = problem, problem.config, folder
        self._at = replace(at, replayed=at.best is None)
        try:
            self.state: SearchState = self._algorithm.restore(at.state)
        except ValueError as error:
            raise CheckpointError(f"{folder.checkpoint}: {error}") from None
        self._before = at.reissued
        self._written = configs.to_dict(self.config)
        self._durable = time.monotonic()
        self._signs = self.config.algorithm_config.signs()
        self._judged, self._keep = problem.spec.success, self.config.traces if problem.spec.traced else "none"
        folder.save(self._at)

    @property
    def run(self) -> str:
        """The run's original name; its folder may have been renamed."""
        return self._at.run

    @property
    def spec(self) -> Spec:
        """The workers' specification, named after the folder, so that copies of a run can continue at the same time."""
        return self.problem.specification(self.folder.name)

    @property
    def canary(self) -> str | None:
        """Fingerprint of the numbers of the machines that simulated so far."""
        return self._at.canary

    @property
    def _algorithm(self) -> Algorithm[Any]:
        """The algorithm with this generation's number of pairs."""
        return self.config.algorithm_of(self._at.pairs)

    @property
    def over(self) -> bool:
        """Whether all generations are done."""
        config, at = self.config, self._at
        # With averaging, all averaged means must have succeeded.
        solved = config.stop_when_solved is not None and at.solved >= max(config.stop_when_solved, config.average)
        spent = config.stop_after_steps is not None and at.steps >= config.stop_after_steps
        return self.state.generation >= config.generations or solved or spent

    def learn(self, farm: Dispatcher) -> Iterator[Report]:
        """Yield generations until the run is over; the next one is simulated while the caller handles a report.

        Raises:
          Diverged: mu or sigma would not be finite; the state before is saved.
          RunError: a job failed on several workers, or a file cannot be written.
          Stopped: the user asked to stop; the last complete generation is saved.
        """
        begun = time.monotonic() - self._at.seconds
        if self.over:
            return
        eps, hopeless = self._explore(farm), False
        while not self.over:
            results, last = farm.collect(), self._at
            rollouts = len(eps) * len(self._signs)  # the following jobs are the mean policy's, and perhaps the best's
            returns = results.returns[:rollouts].reshape(len(eps), len(self._signs))
            before = self.state
            told = learnt_from(self.config, self.problem.task, returns, results.steps[:rollouts])
            self.state = algorithms.tell(self._algorithm, before, eps, told)
            self._note(before, eps, results, told, time.monotonic() - begun, farm)
            if not self.over:
                eps = self._explore(farm)
            progress = self._progress(results, returns, farm)
            try:
                self._save(progress)
            except OSError as error:
                self.state, self._at = before, last
                advice = "make room and --resume it" if error.errno in _FULL else "--resume it"
                raise RunError(
                    f"cannot write to {self.folder.path}: {error.strerror}; the run is saved up to generation "
                    f"{before.generation}: {advice}"
                ) from None
            if progress.failed == returns.size and not hopeless:
                log.warning("all %d rollouts became unstable: farm check shows how they start", returns.size)
            hopeless = progress.failed == returns.size
            farm.report(progress)
            yield Report(
                progress=progress,
                rate=returns.size / max(self._at.seconds - last.seconds, 1e-9),
                sample=results.trajectory(len(eps)),
                traces=_traces(results.traces, returns, self._keep),
                replay=results.trajectory(len(eps) + 1),
                replay_generation=last.best_generation,
            )

    def evaluate(self, farm: Dispatcher) -> Evaluation:
        """The mean policy at the end of the run, averaged over its last generations if the run says so."""
        jobs = Jobs.joined([evaluation_jobs(EVALUATION_ROLLOUTS, EVALUATION_SEED), *self._replay_job()])
        at = self.state.generation
        mu = self.folder.average(at, self.state.mu, self.config.average)
        farm.begin(at, mu, jobs, normaliser=self._normalisers())
        results, last = farm.collect(), EVALUATION_ROLLOUTS
        return Evaluation(
            mean=Nominal(
                value=float(results.returns[last]),
                success=bool(results.flags[last, 0]) if self._judged else None,
                trajectory=results.trajectory(last),
            ),
            robust_success_rate=self._success(results.flags[:last]),
            robust_return=float(np.mean(results.returns[:last])),
            replay=results.trajectory(last + 1),
        )

    def summary(self, state: str, workers: int, evaluation: Evaluation | None) -> dict[str, Any]:
        """The results in summary.json."""
        at = self.state.generation
        rates = [p.success_rate for p in self.folder.progress() if p.generation == at]
        mean = evaluation.mean if evaluation else None
        numbers = self.state.mu.astype("<f8").tobytes() + self.state.sigma.astype("<f8").tobytes()
        return {
            "run": self.folder.name,
            "seed": self.config.seed,
            "generations": at,
            "rollouts": self._at.rollouts,
            "steps": self._at.steps,
            "best_return": self.state.best,
            "mean_policy_return": mean.value if mean else None,
            "mean_policy_success": mean.success if mean else None,
            "success_rate": rates[-1] if rates else None,
            "robust_success_rate": evaluation.robust_success_rate if evaluation else None,
            "robust_return": evaluation.robust_return if evaluation else None,
            "parameters_sha256": hashlib.sha256(numbers).hexdigest(),
            "seconds": round(self._at.seconds, 3),
            "rollouts_per_second": round(self._at.rollouts / self._at.seconds, 1) if self._at.seconds else None,
            "workers": workers,
            "reissued": self._at.reissued,
            "state": state,
        }

    @property
    def best_generation(self) -> int:
        """The generation of the best rollout so far."""
        return self._at.best_generation

    def _explore(self, farm: Dispatcher) -> FloatArray:
        """Draw a generation's eps, and publish its jobs: exploring ones, the mean policy, perhaps the best again."""
        state = self.state
        eps, exploring = explored(self.config, state, self._at.pairs)
        replay = self._replay_job() if state.generation % REPLAY_EVERY == 0 else []
        jobs = Jobs.joined([exploring, Jobs.mean("control", [None]), *replay])
        farm.begin(state.generation, state.mu, jobs, self._keep, self._normalisers())
        return eps

    def _normalisers(self) -> FloatArray:
        """Normalisers of the next round's observations, and of the best rollout's so far, (2, 2, d)."""
        now, best = normaliser(self._at.moments), self._at.best
        return np.stack([now, now if best is None else best.normaliser])

    def _seed(self, generation: int, index: int) -> tuple[int, ...] | None:
        return seeds.training(self.config.seed, generation, index) if self.config.task_config.perturb else None

    def _replay_job(self) -> list[Jobs]:
        """The best rollout so far at physics rate, if it has not been simulated yet."""
        best = self._at.best
        return [] if best is None or self._at.replayed else [Jobs.single(best.theta, "physics", best.seed)]

    def _note(
        self,
        before: SearchState,
        eps: FloatArray,
        results: RoundResults,
        returns: FloatArray,
        seconds: float,
        farm: Dispatcher,
    ) -> None:
        """Update the checkpoint after an update of the algorithm."""
        best, generation = self._at.best, self._at.best_generation
        steps = int(results.steps[: returns.size].sum())
        replayed = self._at.replayed or len(results) > len(eps) + 1
        if before.best is None or returns.max() > before.best:
            row, column = np.unravel_index(int(returns.argmax()), returns.shape)
            theta = before.mu + self._signs[column] * eps[row]
            seed = self._seed(before.generation, int(row))
            best = BestRollout(seed=seed, theta=theta, normaliser=normaliser(self._at.moments))
            generation, replayed = self.state.generation, False
        self._at = replace(
            self._at,
            config=self._written,
            state=self.state.to_dict(),
            rollouts=self._at.rollouts + returns.size,
            steps=self._at.steps + steps,
            pairs=self.config.pairs_after(self._at.pairs, steps),
            reissued=self._before + farm.reissued,
            seconds=seconds,
            solved=self._at.solved + 1 if results.flags[returns.size, 0] else 0,
            best=best,
            best_generation=generation,
            canary=farm.admission.canary,
            replayed=replayed,
            moments=merged(self._at.moments, results.moments[: returns.size]),
        )

    def _progress(self, results: RoundResults, returns: FloatArray, farm: Dispatcher) -> GenerationStats:
        state, flags, mean = self.state, results.flags[: returns.size], returns.size
        _, ended, failed, clamped = np.count_nonzero(flags, axis=0).tolist()
        return GenerationStats(
            generation=state.generation,
            rollouts=self._at.rollouts,
            return_mean=float(returns.mean()),
            return_min=float(returns.min()),
            return_max=float(returns.max()),
            return_std=float(returns.std()),
            best=float(returns.max()) if state.best is None else state.best,
            baseline=state.baseline,
            mean_policy_return=float(results.returns[mean]),
            mean_policy_success=bool(results.flags[mean, 0]) if self._judged else None,
            success_rate=self._success(flags),
            sigma_mean=float(state.sigma.mean()),
            sigma_min=float(state.sigma.min()),
            sigma_max=float(state.sigma.max()),
            mean_norm=float(np.sqrt((state.mu * state.mu).sum())),
            ended=ended,
            failed=failed,
            clamped=clamped,
            reissued=self._at.reissued,
            workers=len(farm.workers),
            seconds=round(self._at.seconds, 3),
        )

    def _success(self, flags: BoolArray) -> float | None:
        """Fraction of the rollouts (S, 4) that succeeded, if the task defines success."""
        return float(np.mean(flags[:, 0])) if self._judged else None

    def _save(self, progress: GenerationStats) -> None:
        mu, sigma, seen = self.state.mu, self.state.sigma, normaliser(self._at.moments)
        self.folder.append(progress, mu, sigma, self.config.generations, seen)
        now = time.monotonic()
        durable = now - self._durable > DURABLE_EVERY
        self._durable = now if durable else self._durable
        self.folder.save(self._at, durable=durable)


def explored(config: RunConfig, state: SearchState, pairs: int = 0) -> tuple[FloatArray, Jobs]:
    """A generation's eps, (rows, P), and its exploring jobs: all its random numbers, seeded by its number."""
    algorithm = config.algorithm_of(pairs)
    eps = algorithms.ask(algorithm, state, seeds.exploration(config.seed, state.generation))
    drawn = None
    if config.task_config.perturb:
        drawn = [seeds.training(config.seed, state.generation, i) for i in range(len(eps))]
    return eps, Jobs.exploring(eps, algorithm.signs(), drawn)


def learnt_from(config: RunConfig, task: Task, returns: FloatArray, steps: IntArray) -> FloatArray:
    """Returns (rows, signs) including the reward's offset, of rollouts with these numbers of steps (S,)."""
    own = config.task_config
    if not own.reward_offset:
        return returns
    weights = [task.return_scale * own.gamma**t * own.reward_offset for t in range(task.steps)]
    offsets = np.array([0.0, *itertools.accumulate(weights)])
    return returns + offsets[steps].reshape(returns.shape)


def _traces(traces: Mapping[int, AnyArray], returns: FloatArray, keep: str) -> dict[str, AnyArray]:
    """The traces to keep, by name; each has (T, N) per rollout."""
    if keep == "none":
        return {}
    rows = {"best": int(returns.argmax()), "worst": int(returns.argmin())}
    # If machines round differently, a job that ran twice may have sent the trace of another rollout.
    kept = {name: traces[row] for name, row in rows.items() if row in traces}
    return {**kept, "all": np.stack([traces[i] for i in range(returns.size)])} if keep == "all" else kept
