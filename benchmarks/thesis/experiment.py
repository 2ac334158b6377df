"""What an experiment is. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from learner.config import RunConfig

if TYPE_CHECKING:
    from benchmarks.thesis.findings import Data, Finding

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
    """Of returns; symlog: logarithmic if they fall by orders of magnitude."""


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """A matrix: each learnt policy on each object."""

    objects: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Success of the learnt policies over friction."""

    factors: tuple[float, ...]
    """Of every friction coefficient."""


@dataclass(frozen=True, kw_only=True)
class KernelError:
    """Error of the kernel's approximation over the number of features; needs no runs."""

    features: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """How many changes of grip an upper level gets out of two learnt policies, the first curve's and the second's."""

    steps: int = 100
    """Control steps of a rollout."""


Figure = Curves | Transfer | Friction | Chain | KernelError


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A named set of runs (configurations x trials) with a question, and the figure that answers it."""

    name: str
    """As in `farm experiment NAME`; the thesis' figure or section, or the question in a word."""
    title: str
    question: str
    claim: str = ""
    """What Plage 2016 reports, and where; empty for questions of ours."""
    curves: Mapping[str, str] = field(default_factory=dict)
    """What a legend says -> name of the set-up (catalogue.SETUPS)."""
    figure: Figure = field(default_factory=Curves)
    find: "Callable[[Data], list[Finding]] | None" = None
    """What the recorded data says to the claim."""


def trial(setup: RunConfig, number: int, generations: int | None = None) -> RunConfig:
    """A set-up's run number 0, 1, ...: its seed; `generations` shortens it."""
    if generations is not None:
        setup = replace(setup, generations=min(generations, setup.generations))
    return replace(setup, seed=number)
