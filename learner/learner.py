"""The learning loop: ask, simulate, tell, save, and say how it went."""

import hashlib
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from farm import randomness, tasks
from farm.arrays import AnyArray, BoolArray, FloatArray
from farm.errors import CheckpointError, RunError
from farm.jobs import Job, Jobs
from farm.messages import Spec
from farm.results import Result
from farm.trajectory import Trajectory
from learner import config as configs
from learner.algorithms import SearchState
from learner.beginning import specification
from learner.checkpoint import Checkpoint
from learner.config import RunConfig
from learner.dispatcher import Dispatcher
from learner.evaluation import EVALUATION_ROLLOUTS, EVALUATION_SEED, Evaluation, evaluation_jobs, mean_job
from learner.folder import RunFolder
from learner.progress import Progress
from learner.report import Report
from learner.round import Round

log = logging.getLogger(__name__)

REPLAY_EVERY: Final = 10
"""Generations between two recordings of the best rollout at physics rate: near its end, most bring a new best."""


class Learner:
    """One run, from its start or its checkpoint to its end."""

    def __init__(self, config: RunConfig, folder: RunFolder, at: Checkpoint) -> None:
        """Take up a run where its checkpoint stands: `start`'s for a new one.

        Raises:
          CheckpointError: the checkpoint does not fit the configuration.
        """
        # The replay of the best is shown again: replay.rrd is written anew by whoever ends the run.
        self.config, self.folder, self._at = config, folder, replace(at, replayed=at.best is None)
        try:
            self.state: SearchState = config.algorithm.restore(at.state)
        except ValueError as error:
            raise CheckpointError(f"{folder.checkpoint}: {error}") from None
        self._before = at.reissued
        sizes = tasks.sizes(config.task)
        self._signs = config.algorithm.signs()
        self._judged, self._keep = sizes.success, config.traces if sizes.fingers else "none"
        folder.save(self._at)

    @property
    def run(self) -> str:
        """The name that the run began with; its folder may have another by now."""
        return self._at.run

    @property
    def spec(self) -> Spec:
        """What workers simulate, under the folder's name: copies of a run may go on side by side."""
        return replace(specification(self.config, self._at), run=self.folder.name)

    @property
    def canary(self) -> str | None:
        """Digest of the numbers of the machines that simulated so far."""
        return self._at.canary

    @property
    def over(self) -> bool:
        """Whether no generation is left to do."""
        solved = self.config.stop_when_solved
        return self.state.generation >= self.config.generations or (solved is not None and self._at.solved >= solved)

    def learn(self, farm: Dispatcher) -> Iterator[Report]:
        """Generations until the run is over; the next one is under way while a report is looked at.

        Raises:
          Diverged: mu or sigma would not be finite; the state before is saved.
          RunError: a job failed on several workers, or a file cannot be written.
          Stopped: the user asked to end; the last whole generation is saved.
        """
        begun = time.monotonic() - self._at.seconds
        if self.over:
            return
        eps = self._explore(farm)
        while not self.over:
            results, last = farm.collect(), self._at
            rollouts = len(eps) * len(self._signs)  # the jobs behind them are the mean policy's, and perhaps the best's
            returns = results.returns[:rollouts].reshape(len(eps), len(self._signs))
            before = self.state
            self.state = self.config.algorithm.tell(before, eps, returns)
            self._note(before, eps, results, returns, time.monotonic() - begun, farm)
            if not self.over:
                eps = self._explore(farm)
            progress = self._progress(results, returns, farm)
            try:
                self._save(progress)
            except OSError as error:
                self.state, self._at = before, last
                raise RunError(
                    f"cannot write to {self.folder.path}: {error.strerror}; the run stands as of generation "
                    f"{before.generation}: make room and --resume it"
                ) from None
            farm.report(progress)
            yield Report(
                progress=progress,
                rate=returns.size / max(self._at.seconds - last.seconds, 1e-9),
                sample=_trajectory(results[len(eps)]),
                traces=_traces(results.traces, returns, self._keep),
                replay=_trajectory(results[-1]) if len(results) > len(eps) + 1 else None,
                replay_generation=last.best_generation,
            )

    def evaluate(self, farm: Dispatcher) -> Evaluation:
        """The mean policy at the end of the run."""
        jobs = evaluation_jobs(EVALUATION_ROLLOUTS, EVALUATION_SEED)
        best = self._replay_job(len(jobs))
        farm.begin(self.state.generation, self.state.mu, Jobs.of([*jobs, *best]))
        results = farm.collect()
        return Evaluation(
            mean=results[EVALUATION_ROLLOUTS],
            robust_success_rate=self._success(results.flags[:EVALUATION_ROLLOUTS]),
            robust_return=float(np.mean(results.returns[:EVALUATION_ROLLOUTS])),
            replay=_trajectory(results[-1]) if best else None,
        )

    def summary(self, state: str, workers: int, evaluation: Evaluation | None) -> dict[str, Any]:
        """What came out, as summary.json says it."""
        at = self.state.generation
        rates = [p.success_rate for p in self.folder.progress() if p.generation == at]
        mean = evaluation.mean if evaluation else None
        numbers = self.state.mu.astype("<f8").tobytes() + self.state.sigma.astype("<f8").tobytes()
        return {
            "run": self.folder.name,
            "seed": self.config.seed,
            "generations": at,
            "rollouts": self._at.rollouts,
            "best_return": self.state.best,
            "mean_policy_return": float(mean.returns[0]) if mean else None,
            "mean_policy_success": bool(mean.success[0]) if mean and self._judged else None,
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
        """Draw a generation's eps, and hand out its jobs: exploring ones, the mean policy, perhaps the best again."""
        config, state = self.config, self.state
        eps = config.algorithm.ask(state, randomness.exploration(config.seed, state.generation))
        seeds = None
        if config.task.perturb:
            seeds = [randomness.training(config.seed, state.generation, i) for i in range(len(eps))]
        mean = mean_job(len(eps), rate="control", perturbation=None)
        replay = self._replay_job(len(eps) + 1) if state.generation % REPLAY_EVERY == 0 else []
        jobs = Jobs.exploring(eps, self._signs, seeds, [mean, *replay])
        farm.begin(state.generation, state.mu, jobs, self._keep)
        return eps

    def _perturbation(self, generation: int, index: int) -> tuple[int, ...] | None:
        return randomness.training(self.config.seed, generation, index) if self.config.task.perturb else None

    def _replay_job(self, index: int) -> list[Job]:
        """The best rollout so far once more at physics rate, if that has not been done."""
        at = self._at
        due = at.best is not None and not at.replayed
        return [replace(at.best, index=index, rate="physics")] if due and at.best else []

    def _note(
        self,
        before: SearchState,
        eps: FloatArray,
        results: Round,
        returns: FloatArray,
        seconds: float,
        farm: Dispatcher,
    ) -> None:
        """Bring the checkpoint up to date after an update."""
        best, generation = self._at.best, self._at.best_generation
        replayed = self._at.replayed or len(results) > len(eps) + 1
        if before.best is None or returns.max() > before.best:
            row, column = np.unravel_index(int(returns.argmax()), returns.shape)
            theta = before.mu + self.config.algorithm.signs()[column] * eps[row]
            seed = self._perturbation(before.generation, int(row))
            best = Job(index=0, origin="zero", signs=(1,), perturbation=seed, rate="none", eps=theta)
            generation, replayed = self.state.generation, False
        self._at = replace(
            self._at,
            config=configs.to_dict(self.config),
            state=self.state.to_dict(),
            rollouts=self._at.rollouts + returns.size,
            reissued=self._before + farm.reissued,
            seconds=seconds,
            solved=self._at.solved + 1 if results[len(eps)].success[0] else 0,
            best=best,
            best_generation=generation,
            canary=farm.admission.canary,
            replayed=replayed,
        )

    def _progress(self, results: Round, returns: FloatArray, farm: Dispatcher) -> Progress:
        state, flags, mean = self.state, results.flags[: returns.size], results[len(returns)]
        _, dropped, failed, clamped = np.count_nonzero(flags, axis=0).tolist()
        return Progress(
            generation=state.generation,
            rollouts=self._at.rollouts,
            return_mean=float(returns.mean()),
            return_min=float(returns.min()),
            return_max=float(returns.max()),
            return_std=float(returns.std()),
            best=float(returns.max()) if state.best is None else state.best,
            baseline=state.baseline,
            mean_policy_return=float(mean.returns[0]),
            mean_policy_success=bool(mean.success[0]) if self._judged else None,
            success_rate=self._success(flags),
            sigma_mean=float(state.sigma.mean()),
            sigma_min=float(state.sigma.min()),
            sigma_max=float(state.sigma.max()),
            mean_norm=float(np.sqrt((state.mu * state.mu).sum())),
            dropped=dropped,
            failed=failed,
            clamped=clamped,
            reissued=self._at.reissued,
            workers=len(farm.workers),
            seconds=round(self._at.seconds, 3),
        )

    def _success(self, flags: BoolArray) -> float | None:
        """Part of the rollouts (S, 4) that succeeded, if the task knows success."""
        return float(np.mean(flags[:, 0])) if self._judged else None

    def _save(self, progress: Progress) -> None:
        self.folder.append(progress, self.state.mu, self.state.sigma, self.config.generations)
        self.folder.save(self._at)


def _trajectory(result: Result) -> Trajectory | None:
    return result.trajectory.trajectory() if result.trajectory else None


def _traces(traces: Mapping[int, AnyArray], returns: FloatArray, keep: str) -> dict[str, AnyArray]:
    """Those of the rollouts' traces, (T, 54) each, that are kept, by name."""
    if keep == "none":
        return {}
    rows = {"best": int(returns.argmax()), "worst": int(returns.argmin())}
    # Where machines of different numbers take part, a doubled job's trace may have travelled in another's place.
    kept = {name: traces[row] for name, row in rows.items() if row in traces}
    return {**kept, "all": np.stack([traces[i] for i in range(returns.size)])} if keep == "all" else kept
