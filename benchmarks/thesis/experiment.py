"""An experiment, and the result of testing its claim on recorded data: findings with numbers, and a verdict."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from benchmarks.thesis.series import Series
from farm.arrays import FloatArray
from learner.config import RunConfig

Panel = Literal["return", "mean policy", "success", "sigma", "mu_2", "sigma_2", "action"]
"""A quantity over the generations, one panel of a figure."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """A figure of quantities over generations or rollouts: mean over the trials, standard deviation shaded."""

    panels: tuple[Panel, ...] = ("return", "mean policy")
    """From left to right."""
    over: Literal["generations", "rollouts"] = "generations"
    """The horizontal axis."""
    scale: Literal["linear", "symlog"] = "linear"
    """Scale of returns; symlog: logarithmic if they fall by orders of magnitude."""


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """A matrix: each learnt policy on each object."""

    objects: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Success of the learnt policies over friction."""

    factors: tuple[float, ...]
    """Factors of all friction coefficients."""


@dataclass(frozen=True, kw_only=True)
class KernelError:
    """Error of the kernel's approximation over the number of features; needs no runs."""

    features: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Number of grip changes if the policies learnt for the first and the second curve act in turn."""

    steps: int = 100
    """Control steps of a rollout."""


Figure = Curves | Transfer | Friction | Chain | KernelError


@dataclass(frozen=True)
class Data:
    """All data of an experiment."""

    series: Mapping[str, Series]
    """Recorded series, by their label in the legend."""
    measured: Mapping[str, FloatArray]
    """Arrays measured on the learnt policies."""
    configs: Mapping[str, RunConfig]
    """Configurations, by their label in the legend."""


@dataclass(frozen=True)
class Finding:
    """One part of a claim, and its result."""

    part: str
    holds: bool
    numbers: str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A named set of runs (configurations x trials), the question that they answer, and its figure."""

    name: str
    """The name in `python -m benchmarks.thesis NAME`: a figure or section of the thesis, or a word for the question."""
    title: str
    question: str
    claim: str = ""
    """What Plage 2016 reports, with the section; empty for our own questions."""
    curves: Mapping[str, str] = field(default_factory=dict)
    """Label in the legend -> name of the set-up (catalogue.SETUPS)."""
    figure: Figure = field(default_factory=Curves)
    find: Callable[[Data], list[Finding]] | None = None
    """Tests the claim on the recorded data."""


def trial(setup: RunConfig, number: int, generations: int | None = None) -> RunConfig:
    """Run number 0, 1, ... of a set-up; the number is its seed, and `generations` shortens it."""
    if generations is not None:
        setup = replace(setup, generations=min(generations, setup.generations))
    return replace(setup, seed=number)


Verdict = Literal["reproduced", "not reproduced", "in part", "open"]


def judge(experiment: Experiment, data: Data) -> list[Finding]:
    """Findings on an experiment's claim; none until all its trials have ended."""
    if experiment.find is None or not all(_over(series) for series in data.series.values()):
        return []
    return experiment.find(data)


def _over(series: Series) -> bool:
    return set(series.states) <= {"finished", "diverged"} and not np.isnan(series.columns["return_mean"][:, 0]).any()


def verdict(findings: Sequence[Finding]) -> Verdict:
    """The verdict on all parts of a claim; open if there are no findings."""
    if not findings:
        return "open"
    held = [finding.holds for finding in findings]
    return "reproduced" if all(held) else "in part" if any(held) else "not reproduced"


def spread(values: FloatArray, digits: int = 2) -> str:
    """Mean and range over the trials, as text."""
    known = values[~np.isnan(values)]
    if not len(known):
        return "none"
    if len(known) == 1:
        return f"{known[0]:.{digits}f}"
    return f"{known.mean():.{digits}f} ({known.min():.{digits}f} to {known.max():.{digits}f})"


def counted(series: Series) -> str:
    """Number of trials that learnt, and the generations from which every mean policy succeeds, as text."""
    since = series.since[series.learnt]
    when = f" (every mean policy succeeds from generation {', '.join(f'{g:.0f}' for g in sorted(since))} on)"
    return f"{int(series.learnt.sum())} of {series.trials} learnt{when if len(since) else ''}"
