"""An experiment, and the result of testing its claim on recorded data: findings with numbers, and a
verdict.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from benchmarks.thesis.series import Series
from benchmarks.thesis.statistics import share
from farm.arrays import FloatArray
from learner.run.config import RunConfig

Panel = Literal["return", "mean policy", "success", "sigma", "mu_2", "sigma_2", "action"]
"""A quantity over the generations, one panel of a figure."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """A figure of quantities over generations or rollouts: mean over the trials, standard deviation
    shaded.
    """

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
    """Number of grip changes if the policies learnt for the first and the second curve act in
    turn.
    """

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


UNDECIDED: Final = "undecided"
"""The trials do not show whether a part of a claim is true."""

UNTESTABLE: Final = "cannot be tested"
"""A part of a claim compares how set-ups learn, but none of them learns."""


@dataclass(frozen=True)
class Finding:
    """One part of a claim, and its result."""

    part: str
    holds: bool | Literal["undecided", "cannot be tested"]
    numbers: str

    @property
    def answer(self) -> str:
        """Whether the part is true, in a word or two."""
        if isinstance(self.holds, str):
            return self.holds
        return "yes" if self.holds else "no"


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A named set of runs (configurations x trials), the question that they answer, and its
    figure.
    """

    name: str
    """The name in `python -m benchmarks.thesis NAME`: a figure or section of the thesis, or a word
    for the question.
    """
    title: str
    question: str
    claim: str = ""
    """What Plage 2016 reports, with the section; empty for our own questions."""
    curves: Mapping[str, str] = field(default_factory=dict)
    """Label in the legend -> name of the set-up (setups.SETUPS)."""
    figure: Figure = field(default_factory=Curves)
    find: Callable[[Data], list[Finding]] | None = None
    """Tests the claim on the recorded data."""
    trials: int = 5
    """Number of trials of each set-up that are shown; the thesis has three.

    More where five decide nothing.
    """


def trial(setup: RunConfig, number: int, generations: int | None = None) -> RunConfig:
    """Run number 0, 1, ... of a set-up; the number is its seed, and `generations` shortens it."""
    if generations is not None:
        setup = replace(setup, generations=min(generations, setup.generations))
    return replace(setup, seed=number)


Verdict = Literal[
    "reproduced", "not reproduced", "in part", "undecided", "cannot be tested", "open"
]


def judge(experiment: Experiment, data: Data) -> list[Finding]:
    """Findings on an experiment's claim; none until all its trials have ended."""
    if experiment.find is None or not all(_over(series) for series in data.series.values()):
        return []
    return experiment.find(data)


def _over(series: Series) -> bool:
    return (
        set(series.states) <= {"finished", "diverged"}
        and not np.isnan(series.columns["return_mean"][:, 0]).any()
    )


def verdict(findings: Sequence[Finding]) -> Verdict:
    """The verdict on all parts of a claim; open if there are no findings."""
    if not findings:
        return "open"
    answers = {finding.holds for finding in findings}
    if answers == {True}:
        return "reproduced"
    if True in answers:
        return "in part"
    if False in answers:
        return "not reproduced"
    return UNDECIDED if UNDECIDED in answers else UNTESTABLE


def spread(values: FloatArray, digits: int = 2) -> str:
    """Mean and range over the trials, as text."""
    numbers = values[~np.isnan(values)]
    if not len(numbers):
        return "none"
    if len(numbers) == 1:
        return f"{numbers[0]:.{digits}f}"
    return f"{numbers.mean():.{digits}f} ({numbers.min():.{digits}f} to {numbers.max():.{digits}f})"


def counted(series: Series) -> str:
    """Number of trials that learnt, its interval, and the generations from which every mean policy
    succeeds.
    """
    since = np.sort(series.since[series.learnt])
    when = ", ".join(f"{g:.0f}" for g in since)
    if len(since) > _LISTED:
        when = f"{np.median(since):.0f} (median; {since[0]:.0f} to {since[-1]:.0f})"
    low, high = share(int(series.learnt.sum()), series.trials)
    text = (
        f"{int(series.learnt.sum())} of {series.trials} learnt ({100 * low:.0f} to"
        f" {100 * high:.0f} %)"
    )
    return f"{text}; every mean policy succeeds from generation {when} on" if len(since) else text


_LISTED: Final = 5  # generations; of more trials the median and the range
