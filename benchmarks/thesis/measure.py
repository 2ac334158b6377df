"""Measurements on the learnt policies of an experiment, in addition to what its runs recorded.

They are stored beside the recorded data, with the hashes of the runs and the figure's settings, and
repeated when these change.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from benchmarks.thesis.claims import SIZES
from benchmarks.thesis.experiment import Chain, Curves, Experiment, Friction, KernelError, Transfer
from benchmarks.thesis.folder import ExperimentFolder
from benchmarks.thesis.series import load, read_arrays, write_arrays
from farm import seeds
from farm.arrays import AnyArray
from farm.errors import ConfigError
from farm.policies.fourier import FeaturesConfig, Projected
from farm.sim.sim import Sim
from farm.tasks.base import TaskSpec
from farm.tasks.finger_gait.hand import LOWER, UPPER
from farm.tasks.finger_gait.holding import SUCCESS_STEPS
from farm.tasks.finger_gait.sensing import Perturbation
from farm.tasks.finger_gait.task import FingerGait
from farm.tasks.rollouts import Seed
from learner.run.evaluation import EVALUATION_ROLLOUTS, EVALUATION_SEED
from learner.run.folder import RunFolder
from learner.tools.chain.chain import chain
from learner.tools.replay.loaded import LoadedPolicy, loaded
from learner.tools.replay.loaded import load as load_policy

_POINTS: Final = 40
"""Number of states; the kernel is compared for all pairs of them."""

_AT_LIMIT: Final = 1e-9  # [rad]


def measure(folder: ExperimentFolder, experiment: Experiment) -> None:
    """Make the measurements for an experiment's figure, unless they exist for these runs.

    Raises:
      ConfigError: they do not exist, and neither do the runs.
    """
    measuring = _measuring(experiment)
    if measuring is None:
        return
    path = folder.measured(experiment)
    count = folder.shown(experiment)
    curves = {
        name: load(folder.path / "data" / f"{name}.npz") for name in experiment.curves.values()
    }
    of = {"hashes": np.array([digest for series in curves.values() for digest in series.hashes])}
    of["recorded"] = np.array(
        [(~np.isnan(series.columns["return_mean"])).sum(axis=1) for series in curves.values()]
    )
    of |= {"trials": np.array(count), "figure": np.array(repr(experiment.figure))}
    if path.exists():
        arrays = read_arrays(path)
        if all(
            name in arrays and np.array_equal(arrays[name], value) for name, value in of.items()
        ):
            return
    for name, series in curves.items():
        for number, digest in enumerate(series.hashes):
            if digest and not folder.run(name, number).checkpoint.exists():
                raise ConfigError(
                    f"cannot measure for {experiment.name}: {folder.run(name, number).path} is gone"
                )
    write_arrays(path, {**measuring(folder, experiment), **of})


Measuring = Callable[[ExperimentFolder, Experiment], dict[str, AnyArray]]


def _measuring(experiment: Experiment) -> Measuring | None:
    figure = experiment.figure
    if isinstance(figure, Curves):
        return _actions if "action" in figure.panels else None
    return {Transfer: _transfer, Friction: _friction, Chain: _chain, KernelError: _kernel_error}[
        type(figure)
    ]


def _trials(folder: ExperimentFolder, experiment: Experiment, setup: str) -> list[RunFolder | None]:
    """A set-up's runs that an experiment shows; None for a run without a learnt policy."""
    runs = [folder.run(setup, number) for number in range(folder.shown(experiment))]
    return [run if run.checkpoint.exists() else None for run in runs]


def _actions(folder: ExperimentFolder, experiment: Experiment) -> dict[str, AnyArray]:
    """Size of the mean policy's actions in each generation.

    Returns:
      action: (set-ups, trials, generations) largest action of the rollout, in units of its joint's
          range;
      saturated: (set-ups, trials, generations) share of the rollout's joint targets at or beyond a
          joint's limits.
    """
    names = list(experiment.curves.values())
    longest = max(folder.config(name, 0).generations for name in names)
    action = np.full((len(names), folder.shown(experiment), longest), np.nan)
    saturated = action.copy()
    for i, name in enumerate(names):
        for trial, run in enumerate(_trials(folder, experiment, name)):
            if run is None or not run.progress():
                continue
            rows = run.parameters.rows()
            rollouts = loaded(run).runner.rollouts(rows["mu"].astype(float), [None] * len(rows))
            at = rows["generation"] - 1
            with np.errstate(over="ignore"):
                action[i, trial, at] = (np.abs(rollouts.actions) / (UPPER - LOWER)).max(axis=(1, 2))
            targets = rollouts.frames["target"]
            acting = np.arange(targets.shape[1]) < rollouts.steps[:, None]
            limit = (targets <= LOWER + _AT_LIMIT) | (targets >= UPPER - _AT_LIMIT)
            saturated[i, trial, at] = (limit & acting[..., None]).sum(axis=(1, 2)) / (
                acting.sum(axis=1) * len(LOWER)
            )
    return {"action": action, "saturated": saturated}


def _transfer(folder: ExperimentFolder, experiment: Experiment) -> dict[str, AnyArray]:
    """Robust success of each learnt policy on each object.

    Returns:
      transfer: (set-ups, trials, objects).
    """
    assert isinstance(experiment.figure, Transfer)
    objects = experiment.figure.objects
    rate = np.full((len(experiment.curves), folder.shown(experiment), len(objects)), np.nan)
    for i, name in enumerate(experiment.curves.values()):
        for trial, run in enumerate(_trials(folder, experiment, name)):
            for j, item in enumerate(objects if run else ()):
                assert run
                rate[i, trial, j] = _success(load_policy(run.path, object=item))
    return {"transfer": rate}


def _friction(folder: ExperimentFolder, experiment: Experiment) -> dict[str, AnyArray]:
    """Robust success of learnt policies at each friction; everything else is perturbed as in an
    evaluation.

    Returns:
      success: (set-ups, trials, factors); factors.
    """
    assert isinstance(experiment.figure, Friction)
    factors = experiment.figure.factors
    rate = np.full((len(experiment.curves), folder.shown(experiment), len(factors)), np.nan)
    for i, name in enumerate(experiment.curves.values()):
        for trial, run in enumerate(_trials(folder, experiment, name)):
            if run is None:
                continue
            for j, factor in enumerate(factors):
                rate[i, trial, j] = _success(_at_friction(loaded(run), factor))
    return {"success": rate, "factors": np.array(factors)}


class _OneFriction(FingerGait):
    """The task with the same friction in every rollout; mass, position and joint readings are
    perturbed as usual.
    """

    factor = 1.0
    """Factor of all friction coefficients."""

    def _set_conditions(self, sim: Sim, perturbations: Sequence[Perturbation]) -> None:
        super()._set_conditions(
            sim, [replace(each, friction=self.factor) for each in perturbations]
        )


def _at_friction(policy: LoadedPolicy, factor: float) -> LoadedPolicy:
    """The same policy, at one friction."""
    problem = policy.problem
    task = _OneFriction(problem.task.config, files=problem.task.sources)
    task.factor = factor
    return LoadedPolicy(replace(problem, task=task), policy.generation, policy.mu)


def _success(policy: LoadedPolicy) -> float:
    """Share of the evaluation's perturbed rollouts that succeed."""
    theta = np.repeat(policy.mu[None], EVALUATION_ROLLOUTS, axis=0)
    return float(policy.runner.rollouts(theta, _drawn()).success.mean())


def _drawn() -> list[Seed]:
    """Seeds of the evaluation's perturbations."""
    return [seeds.evaluation_start(EVALUATION_SEED, i) for i in range(EVALUATION_ROLLOUTS)]


def _chain(folder: ExperimentFolder, experiment: Experiment) -> dict[str, AnyArray]:
    """How often the grip changes when two learnt policies act in turn, on the evaluation's
    perturbed starts.

    Returns:
      reached: (trials, changes) share of the rollouts with at least this number of changes;
      acting: (steps,) and force: (steps, 3) [N] of the first trial's first rollout.
    """
    assert isinstance(experiment.figure, Chain)
    steps = experiment.figure.steps
    most = steps // SUCCESS_STEPS
    reached = np.full((folder.shown(experiment), most + 1), np.nan)
    example: dict[str, AnyArray] = {"acting": np.full(steps, -1), "force": np.zeros((steps, 3))}
    trials = (_trials(folder, experiment, name) for name in experiment.curves.values())
    for trial, runs in enumerate(zip(*trials, strict=True)):
        policies = [loaded(run) for run in runs if run is not None]
        if len(policies) == len(runs):
            chained = chain(policies, _drawn(), steps)
            reached[trial] = [(chained.changes >= k).mean() for k in range(most + 1)]
            if trial == 0:
                example = {
                    "acting": chained.acting[0],
                    "force": chained.rollouts.frames["force"][0].sum(axis=-1),
                }
    return {"reached": reached, **example}


def _kernel_error(folder: ExperimentFolder, experiment: Experiment) -> dict[str, AnyArray]:
    """Largest error of the kernel over all pairs of states whose numbers are drawn from U(0, 1).

    Returns:
      error: (sizes, counts), the mean over the trials' draws of features; sizes; features.
    """
    assert isinstance(experiment.figure, KernelError)
    counts = experiment.figure.features
    error = np.zeros((len(SIZES), len(counts)))
    for i, size in enumerate(SIZES):
        states = np.random.default_rng(0).uniform(size=(_POINTS, size))
        squares = ((states[:, None] - states) ** 2).sum(axis=-1)
        for j, count in enumerate(counts):
            for trial in range(folder.shown(experiment)):
                config = FeaturesConfig(features=count)
                spec = TaskSpec(observation=size, action=1, steps=1, period=1.0)
                policy = Projected(
                    config, spec, Projected.draw(config, spec, seeds.features(trial))
                )
                mapped = policy.features(states)
                error[i, j] += np.abs(
                    mapped @ mapped.T - np.exp(-squares / 2)
                ).max() / folder.shown(experiment)
    return {"error": error, "sizes": np.array(SIZES), "features": np.array(counts)}
