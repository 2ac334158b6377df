"""What recorded data says to a claim: its parts, each with its numbers, and a verdict over them. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.thesis.experiment import Experiment
from benchmarks.thesis.series import Series
from farm.arrays import FloatArray
from learner.config import RunConfig


@dataclass(frozen=True)
class Data:
    """All that is known of an experiment."""

    series: Mapping[str, Series]
    """By what the legend says."""
    measured: Mapping[str, FloatArray]
    """What was measured on the learnt policies."""
    configs: Mapping[str, RunConfig]
    """The set-ups, by what the legend says."""


@dataclass(frozen=True)
class Finding:
    """One part of a claim, and what came out."""

    part: str
    holds: bool
    numbers: str


Verdict = Literal["reproduced", "not reproduced", "in part", "open"]


def judge(experiment: Experiment, data: Data) -> list[Finding]:
    """What the data says to an experiment's claim; nothing before every trial of it is over."""
    if experiment.find is None or not all(_over(series) for series in data.series.values()):
        return []
    return experiment.find(data)


def _over(series: Series) -> bool:
    return set(series.states) <= {"finished", "diverged"} and not np.isnan(series.columns["return_mean"][:, 0]).any()


def verdict(findings: Sequence[Finding]) -> Verdict:
    """Over all parts of a claim; open if nothing is known of them."""
    if not findings:
        return "open"
    held = [finding.holds for finding in findings]
    return "reproduced" if all(held) else "in part" if any(held) else "not reproduced"


def spread(values: FloatArray, digits: int = 2) -> str:
    """Mean and range of what the trials gave."""
    known = values[~np.isnan(values)]
    if not len(known):
        return "none"
    if len(known) == 1:
        return f"{known[0]:.{digits}f}"
    return f"{known.mean():.{digits}f} ({known.min():.{digits}f} to {known.max():.{digits}f})"


def counted(series: Series) -> str:
    """How many trials learnt, and since when."""
    since = series.since[series.learnt]
    when = f", each mean policy succeeding from generation {', '.join(f'{g:.0f}' for g in sorted(since))} on"
    return f"{int(series.learnt.sum())} of {series.trials} learnt{when if len(since) else ''}"
