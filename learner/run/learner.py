"""The learning loop: ask for samples, simulate, tell the results, save, and report."""

import errno
import hashlib
import itertools
import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from farm import fingerprint, seeds
from farm.arrays import FloatArray, IntArray
from farm.errors import CheckpointError, RunError
from farm.moments import merged, normaliser_of
from farm.net.messages import Spec
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report
from farm.net.work import Jobs
from farm.processes import cores
from farm.returns import known, mean, penalised
from farm.tasks.base import Task
from learner import algorithms
from learner.algorithms import Algorithm, SearchState
from learner.pool.pool import Pool
from learner.pool.round import RoundResults
from learner.run import config as configs
from learner.run import hash_chain
from learner.run.checkpoint import BestRollout, Checkpoint, Validated
from learner.run.config import RunConfig
from learner.run.diagnosis import Diagnosis
from learner.run.evaluation import (
    EVALUATION_ROLLOUTS,
    EVALUATION_SEED,
    NOMINAL,
    Evaluation,
    Nominal,
    failures,
    means_of_measures,
    outcome,
    score,
    starts_of_evaluation,
    starts_of_validation,
    success_rate,
    validation,
    whole_round,
)
from learner.run.folder import RunFolder
from learner.run.parts import Parts
from learner.run.setup import Problem
from learner.run.states import RolledBack, goes_back_to
from learner.run.worth import without_learning

log = logging.getLogger(__name__)

REPLAY_EVERY: Final = 10
"""Generations between two recordings of the best rollout at physics rate: late in a run, most have
a new best.
"""

HOPELESS: Final = 3
"""Successive generations in which all rollouts failed, after which a run ends."""

DURABLE_EVERY: Final = 1.0
"""Time between two checkpoints that survive a power failure [s].

The others survive a killed learner only.
"""

_MEASURED: Final = ("mean_policy_measures", "robust_measures")
"""Fields of the summary that hold the task's measures."""
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
        if at.config.get("average") != self.config.average:  # its last policy is another one
            self._at = replace(self._at, last_score=None)
            folder.forget_summary()
        try:
            self.state: SearchState = self._algorithm.restore(at.state)
        except ValueError as error:
            raise CheckpointError(f"{folder.checkpoint}: {error}") from None
        self._before, self._checks = at.reissued, at.checks
        self._written = configs.to_dict(self.config)
        self._durable = time.monotonic()
        self._signs = self.config.algorithm_config.signs()
        self._has_success = problem.spec.success
        self._keep = self.config.traces if problem.spec.trace_channels else "none"
        folder.keep_files(problem.task.sources)
        folder.save(self._at)

    @property
    def run(self) -> str:
        """The id of its recordings: the run's original name, as its folder may have been renamed.

        What a run records after it went back is another recording than what it recorded before.
        """
        return f"{self._at.run}-undone{self.undone}" if self.undone else self._at.run

    @property
    def undone(self) -> int:
        """Generations that were repeated because a host in them was expelled."""
        return self._at.undone

    @property
    def spec(self) -> Spec:
        """The workers' specification, named after the folder, so that copies of a run can continue
        at the same time.
        """
        return self.problem.specification(self.folder.name)

    @property
    def at(self) -> Checkpoint:
        """Checkpoint after the last generation."""
        return self._at

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the machines whose numbers the run accepts, or how it begins."""
        return self._at.fingerprint

    @property
    def _algorithm(self) -> Algorithm[Any]:
        """The algorithm with this generation's number of pairs and steps."""
        return self.config.algorithm_of(self._at.pairs, self._at.shrinking.share)

    @property
    def over(self) -> bool:
        """Whether all generations of the run are done, or it need not go on."""
        return self.state.generation >= self.config.generations or bool(self.early)

    @property
    def early(self) -> str:
        """Why the run ends before its last generation; empty if it does not."""
        config, at = self.config, self._at
        if self.state.generation >= config.generations:
            return ""
        # With averaging, all averaged means must have succeeded.
        if config.stop_when_solved is not None and at.solved >= max(
            config.stop_when_solved, config.average
        ):
            return "the mean policy succeeds (--stop-when-solved)"
        if config.stop_after_steps is not None and at.steps >= config.stop_after_steps:
            return f"{at.steps} control steps are done (--stop-after-steps)"
        if (
            config.stop_when_stale is not None
            and at.validated is not None
            and self.state.generation - at.validated.generation >= config.stop_when_stale
        ):
            return (
                f"no validated policy has been better for {config.stop_when_stale} generations"
                " (--stop-when-stale)"
            )
        return ""

    def learn(self, pool: Pool) -> Iterator[Report]:
        """Yield generations until the run is over.

        The next one is simulated while the caller handles a report.

        Raises:
          Diverged: mu or sigma would not be finite; the state before is saved.
          RolledBack: an expelled host had answered in earlier generations; a resume repeats them.
          RunError: a job failed on several workers, or a file cannot be written.
          Stopped: the user asked to stop; the last complete generation is saved.
        """
        start = time.monotonic() - self._at.seconds
        if self.over:
            return
        diagnosis = Diagnosis(self.config.algorithm_of())
        for earlier in self.folder.progress():
            diagnosis.after(earlier, one_step=self._one_step)
        all_failed = 0
        going = self._explore(pool)
        while not self.over:
            results = self._collected(pool)
            last = self._at
            before = self.state
            eps, parts = going
            explore = parts.rows("explore")
            learnt = learnt_from(
                self.config, self.problem.task, results.returns[explore], results.steps[explore]
            )
            self.state = algorithms.tell(self._algorithm, before, eps, learnt)
            self._note(before, results, parts, learnt, time.monotonic() - start, pool)
            if not self.over:
                going = self._explore(pool)
            progress = self._progress(results, parts, pool)
            all_failed = all_failed + 1 if progress.return_mean is None else 0
            try:
                self._save(progress, last)
            except OSError as error:
                self.state, self._at = before, last
                raise self._unwritten(error, before.generation) from None
            for message in diagnosis.after(progress, one_step=self._one_step):
                log.warning("%s", message)
            pool.report(progress)
            yield Report(
                progress=progress,
                rate=parts.size("explore") / max(self._at.seconds - last.seconds, 1e-9),
                sample=results.trajectory(parts.job("mean")),
                traces=results.kept_traces(parts.size("explore")),
                replay=results.trajectory(parts.job("replay")),
                replay_generation=last.best_generation,
            )
            if all_failed == HOPELESS:
                raise RunError(
                    f"all rollouts of {HOPELESS} generations failed, so that nothing is learnt:"
                    " farm check says why"
                )

    def _unwritten(self, error: OSError, generation: int) -> RunError:
        """What to say of a file that could not be written after this generation."""
        if not self.folder.there:
            return RunError(f"{self.folder.gone}, after generation {generation}")
        advice = "make room and --resume it" if error.errno in _FULL else "--resume it"
        return RunError(
            f"cannot write to {self.folder.path}: {error.strerror}; the run is saved up to"
            f" generation {generation}: {advice}"
        )

    def _checked(self, pool: Pool) -> dict[str, int]:
        """Number of checks that each host has passed in the whole run."""
        now = pool.checks
        return {
            name: self._checks.get(name, 0) + now.get(name, 0)
            for name in sorted({*self._checks, *now})
        }

    def _collected(self, pool: Pool, *, checked: bool = False) -> RoundResults:
        """A round's results, perhaps with all checks made; hosts that are expelled meanwhile are
        saved at once, so that no resume admits them.
        """
        for _ in pool.progress(checked=checked):
            if pool.admission.expelled.keys() != self._at.expelled.keys():
                self._expelled(pool)
        return pool.collect()

    def _expelled(self, pool: Pool) -> None:
        """Save the expelled hosts, so that no resume admits or believes them.

        Raises:
          RolledBack: their numbers are in the state.
        """
        self._at = replace(self._at, expelled=dict(pool.admission.expelled))
        failed = None
        try:
            self.folder.save(self._at)
        except OSError as error:  # if nothing else needs it, the generation's end says so
            failed = error
        if (generation := goes_back_to(self._at)) is not None:
            if failed is not None:
                raise RunError(
                    f"cannot write to {self.folder.path}: {failed.strerror}; the run has answers of"
                    f" {', '.join(self._at.expelled)}, whose numbers are wrong: begin it anew"
                ) from None
            message = (
                f"the run goes back to generation {generation}, before the first answer of a host"
                " that is expelled"
            )
            log.warning("%s; what follows is repeated", message)
            raise RolledBack(f"{message}: --resume {self.folder.path} repeats what follows")

    def evaluate(self, pool: Pool, *, compare: bool = True) -> Evaluation:
        """The run's policy at its end: the last mean, averaged if the run says so, or a validated
        one.

        With `compare`, and if the run validates, beside doing nothing and a constant action.
        """
        mu = self.folder.parameters.average(
            self.state.generation, self.state.mu, self.config.average
        )
        normalisers = self._normalisers()
        if self.config.validate:
            last = self._checked_results(pool, mu, starts_of_validation(self.config), normalisers)
            self._at = replace(self._at, last_score=score(last.returns))
        parts = Parts(
            starts=starts_of_evaluation(EVALUATION_ROLLOUTS, EVALUATION_SEED),
            nominal=NOMINAL,
            replay=self._replay_job(),
        )
        if (better := self._at.better) is not None:
            mu, normalisers[0] = better.mu, better.normaliser
        results = self._checked_results(pool, mu, parts.jobs, normalisers)
        starts = parts.rows("starts")
        nominal = parts.rows("nominal")
        self._at = replace(self._at, checks=self._checked(pool))
        try:
            self.folder.save(self._at)
        except OSError as error:
            raise self._unwritten(error, self.state.generation) from None
        comparing = compare and self.config.validate
        alike = comparing and fingerprint.digest().startswith(self.fingerprint)
        processes = len(pool.worker_pids) or cores()
        worth = without_learning(self.problem, pool.stopped, processes) if alike else None
        return Evaluation(
            mean=Nominal(
                value=mean(results.returns[nominal]),
                success=bool(results.flags[nominal, 0].all()) if self._has_success else None,
                trajectory=results.trajectory(parts.job("nominal")),
            ),
            robust_success_rate=success_rate(self.problem.spec, results.flags[starts]),
            robust_return=mean(results.returns[starts]),
            robust_failed=failures(results.flags[starts]),
            robust_score=score(results.returns[starts]),
            measures=(
                means_of_measures(self.problem.spec, results, nominal),
                means_of_measures(self.problem.spec, results, starts),
            ),
            without_learning=worth,
            replay=results.trajectory(parts.job("replay")),
        )

    def _checked_results(
        self, pool: Pool, mu: FloatArray, jobs: Jobs, normalisers: FloatArray
    ) -> RoundResults:
        """Results of jobs around a mean (P,) at the end of the run, after which nobody checks them
        any more.
        """
        pool.begin(self.state.generation, mu, jobs, normaliser=normalisers)
        return self._collected(pool, checked=True)

    def summary(self, state: str, workers: int, evaluation: Evaluation | None) -> dict[str, Any]:
        """The results in summary.json."""
        at = self.state.generation
        last = self.folder.last_progress()
        nominal = evaluation.mean if evaluation else None
        numbers = self.state.mu.astype("<f8").tobytes() + self.state.sigma.astype("<f8").tobytes()
        return {
            "run": self.folder.name,
            "seed": self.config.seed,
            "generations": at,
            "rollouts": self._at.rollouts,
            "steps": self._at.steps,
            "best_return": self.state.best,
            "mean_policy_return": nominal.value if nominal else None,
            "mean_policy_success": nominal.success if nominal else None,
            "success_rate": last.success_rate if last and last.generation == at else None,
            "robust_success_rate": evaluation.robust_success_rate if evaluation else None,
            "robust_return": evaluation.robust_return if evaluation else None,
            "robust_failed": evaluation.robust_failed if evaluation else None,
            "robust_score": evaluation.robust_score if evaluation else None,
            **(
                dict(zip(_MEASURED, evaluation.measures, strict=True))
                if evaluation and self.problem.spec.measures
                else {}
            ),
            **(self._validation(evaluation) if self.config.validate else {}),
            "parameters_sha256": hashlib.sha256(numbers).hexdigest(),
            "seconds": round(self._at.seconds, 3),
            "rollouts_per_second": (
                round(self._at.rollouts / self._at.seconds, 1) if self._at.seconds else None
            ),
            "workers": workers,
            "reissued": self._at.reissued,
            "checks": self._at.checks,
            "undone": self._at.undone,
            "chain": self._at.chain,
            "state": state,
        }

    def _validation(self, evaluation: Evaluation | None) -> dict[str, Any]:
        """What summary.json says of the run's policy, with validation."""
        better, best = self._at.better, self._at.validated
        policy_generation = better.generation if better else self.state.generation
        compared = evaluation and evaluation.without_learning
        return {
            "policy_generation": policy_generation if evaluation else None,
            "best_validation": best.score if best else None,
            "last_validation": self._at.last_score,
            **({"without_learning": compared} if compared else {}),
        }

    @property
    def _one_step(self) -> bool:
        """Whether every rollout so far was over after one control step, of several."""
        return self._at.steps == self._at.rollouts and self.problem.task.steps > 1

    @property
    def best_generation(self) -> int:
        """The generation of the best rollout so far."""
        return self._at.best_generation

    def _explore(self, pool: Pool) -> tuple[FloatArray, Parts]:
        """Draw a generation's eps, and publish its jobs; return both."""
        state = self.state
        eps, exploring = explored(self.config, state, self._at.pairs)
        replay = self._replay_job() if state.generation % REPLAY_EVERY == 0 else None
        parts = whole_round(self.config, state.generation, exploring, rate="control", replay=replay)
        pool.begin(state.generation, state.mu, parts.jobs, self._keep, self._normalisers())
        return eps, parts

    def _normalisers(self) -> FloatArray:
        """Normalisers of the next round's observations, and of the best rollout's so far, (2, 2,
        d).
        """
        now, best = normaliser_of(self._at.moments), self._at.best
        return np.stack([now, now if best is None else best.normaliser])

    def _replay_job(self) -> Jobs | None:
        """The best rollout so far at physics rate, if it has not been simulated yet."""
        best = self._at.best
        if best is None or self._at.replayed:
            return None
        return Jobs.single(best.theta, "physics", best.seed)

    def _note(
        self,
        before: SearchState,
        results: RoundResults,
        parts: Parts,
        scores: FloatArray,
        seconds: float,
        pool: Pool,
    ) -> None:
        """Update the checkpoint from a round's results, and the scores (rows, signs) that the
        algorithm was told.
        """
        best = self._at.best
        generation = self._at.best_generation
        explore = parts.rows("explore")
        returns = results.returns[explore]
        steps = int(results.steps[explore].sum())
        replayed = self._at.replayed or bool(results.jobs.physics.any())
        if known(scores).any() and (before.best is None or scores.max() > before.best):
            row, column = divmod(int(scores.argmax()), len(self._signs))
            # The best one of the best
            episode = int(returns.reshape(-1, *scores.shape)[:, row, column].argmax())
            job = results.jobs.take([episode * len(scores) + row])
            seed, theta = job.seeds()[column], job.theta(before.mu)[column]
            best = BestRollout(seed=seed, theta=theta, normaliser=normaliser_of(self._at.moments))
            generation, replayed = self.state.generation, False
        self._at = replace(
            self._at,
            config=self._written,
            state=self.state.to_dict(),
            rollouts=self._at.rollouts + returns.size,
            steps=self._at.steps + steps,
            pairs=self.config.pairs_after(self._at.pairs, steps),
            reissued=self._before + pool.reissued,
            checks=self._checked(pool),
            seconds=seconds,
            first=dict.fromkeys(pool.hosts, before.generation) | self._at.first,
            solved=self._at.solved + 1 if results.flags[parts.rows("mean"), 0].all() else 0,
            best=best,
            best_generation=generation,
            replayed=replayed,
            moments=merged(self._at.moments, results.moments[explore]),
            last_score=None,
            **self._validated(before, validation(parts, results.returns)),
        )

    def _validated(self, before: SearchState, value: float | None) -> dict[str, Any]:
        """Fields of the checkpoint that change after a generation whose mean has this score, if it
        has one: the best validated policy, and what follows for the steps.
        """
        if value is None:
            return {}
        best = self._at.validated
        better = best is None or value > best.score
        patience = self.config.shrink_after
        shrinking = self._at.shrinking.after(better=better, patience=patience)
        if not better:
            return {"shrinking": shrinking}
        best = Validated(
            score=value,
            generation=before.generation,
            mu=before.mu,
            normaliser=normaliser_of(self._at.moments),
        )
        return {"shrinking": shrinking, "validated": best}

    def _progress(self, results: RoundResults, parts: Parts, pool: Pool) -> GenerationStats:
        state = self.state
        figures = outcome(self.problem.spec, results, parts)
        return GenerationStats(
            **figures,
            validation=validation(parts, results.returns),
            generation=state.generation,
            rollouts=self._at.rollouts,
            best=figures["return_max"] if state.best is None else state.best,
            baseline=state.baseline,
            sigma_mean=float(state.sigma.mean()),
            sigma_min=float(state.sigma.min()),
            sigma_max=float(state.sigma.max()),
            mean_norm=float(np.sqrt((state.mu * state.mu).sum())),
            reissued=self._at.reissued,
            workers=len(pool.workers),
            seconds=round(self._at.seconds, 3),
        )

    def _save(self, progress: GenerationStats, last: Checkpoint) -> None:
        if self._at.first != last.first:
            self.folder.states.keep(last)
        mu, sigma, normaliser = self.state.mu, self.state.sigma, normaliser_of(self._at.moments)
        state = hash_chain.state_of(self._at)
        entry = hash_chain.ChainEntry(
            hash_chain.following(last.chain, progress, mu, sigma, normaliser, state), state
        )
        self._at = replace(self._at, chain=entry.digest)
        self.folder.append(progress, mu, sigma, self.config.generations, normaliser, entry)
        now = time.monotonic()
        durable = now - self._durable > DURABLE_EVERY
        self._durable = now if durable else self._durable
        self.folder.save(self._at, durable=durable)


def explored(config: RunConfig, state: SearchState, pairs: int = 0) -> tuple[FloatArray, Jobs]:
    """A generation's eps, (rows, P), and its exploring jobs: all its random numbers, seeded by its
    number.

    Each row has its own start, or one of the shared ones in turn. With several episodes the jobs of
    all rows come on the first start, then on the second (common random numbers), so that rollouts
    of a message share a start.
    """
    algorithm, episodes = config.algorithm_of(pairs), config.episodes
    eps = algorithms.ask(algorithm, state, seeds.exploration(config.seed, state.generation))
    rows = np.arange(len(eps))
    if episodes > 1:
        indices = np.repeat(np.arange(episodes), len(eps))
    else:
        indices = rows if config.shared_starts is None else rows % config.shared_starts
    starts = None
    if config.task_config.perturb:
        starts = [
            seeds.training(config.seed, state.generation, start) for start in indices.tolist()
        ]
    return eps, Jobs.exploring(
        eps if episodes == 1 else np.tile(eps, (episodes, 1)), algorithm.signs(), starts
    )


def learnt_from(config: RunConfig, task: Task, returns: FloatArray, steps: IntArray) -> FloatArray:
    """What the algorithm is told, (rows, signs): mean returns over the episodes, with the reward's
    offset.

    Failed rollouts count as in `farm.returns.penalised`, among all of the generation.

    Args:
      config: of the run.
      task: its task.
      returns: of the rollouts of `explored`, (S,).
      steps: their numbers of control steps, (S,).
    """
    task_config = config.task_config
    if task_config.reward_offset:
        weights = [
            task.return_scale * task_config.gamma**t * task_config.reward_offset
            for t in range(task.steps)
        ]
        offsets = np.array([0.0, *itertools.accumulate(weights)])[steps]
        returns = np.where(known(returns), returns + offsets, returns)
    returns = penalised(returns)
    first, *others = returns.reshape(config.episodes, -1, len(config.algorithm_config.signs()))
    total = first.copy()
    for each in others:  # in their order
        total += each
    return total / config.episodes
