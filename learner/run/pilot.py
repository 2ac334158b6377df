"""A pilot: measures, before a run begins, how far its search has to explore to tell directions apart.

No size of the first perturbations fits all robots: one that barely moves an arm topples a standing robot. For each
sigma of a ladder, K pairs mu +- sigma e_k, e_k ~ N(0, I), are simulated from the same S starts. Their differences
d_ks = r(mu + sigma e_k, s) - r(mu - sigma e_k, s) give

    signal = std over k of mean over s of d_ks,      noise = mean over k of std over s of d_ks / sqrt(S).

The sigma of the largest worth is taken,

    worth = signal * signal^2 / (signal^2 + noise^2) * exp(-max(r_0 - r, 0) / (2 signal)),

where r is the mean return at this sigma and r_0 that at the smallest one: returns differ much between directions,
reliably, and exploring does not cost more than it tells. A sigma with which many more rollouts end early or fail than
with the smallest is not taken: a robot that stands must not learn from its falls. The directions are the same for each
sigma.

It is simulated by this process, so that its result depends on no worker: a run has it before it exists.
"""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import FloatArray
from farm.errors import Interrupted
from farm.moments import merged, normaliser_of
from farm.net.work import NOT_NORMALISED, Jobs
from farm.returns import known, mean, penalised
from farm.runner import Runner
from learner.run.config import RunConfig
from learner.run.setup import problem

log = logging.getLogger(__name__)

PAIRS: Final = 8
"""Directions, K."""

STARTS: Final = 4
"""Starts that all of them share, S."""

_LADDER: Final = tuple(10.0 ** (-step / 2.0) for step in range(5))  # of the largest sigma
_MORE_LOST: Final = 0.1  # share of the rollouts that may end early or fail beyond those at the smallest sigma
_LARGEST: Final = 0.3  # at least, whatever the algorithm begins with
_NORMALISING: Final = 2  # rounds in which the normaliser settles to what exploring at a sigma observes


@dataclass(frozen=True)
class Tried:
    """What exploring at one sigma gave."""

    sigma: float
    returned: float | None
    """Mean return of the rollouts that have one."""
    failed: int
    ended: int
    """Rollouts that the task ended early."""
    signal: float
    noise: float

    @property
    def lost(self) -> int:
        """Rollouts that ended early or failed."""
        return self.ended + self.failed

    def worth(self, quiet: "Tried") -> float:
        """By what sigmas are compared; `quiet` is what the smallest one gave."""
        if self.signal <= 0.0 or self.returned is None:
            return 0.0
        square = self.signal * self.signal
        cost = 0.0 if quiet.returned is None else max(quiet.returned - self.returned, 0.0)
        return self.signal * square / (square + self.noise * self.noise) * math.exp(-cost / (2.0 * self.signal))

    @property
    def line(self) -> str:
        """In words."""
        value = "-" if self.returned is None else f"{self.returned:.4g}"
        parts = [f"{count} {what}" for count, what in ((self.ended, "ended early"), (self.failed, "failed")) if count]
        lost = f", {' and '.join(parts)} of {2 * PAIRS * STARTS}" if parts else ""
        ratio = f"{self.signal / self.noise:.2g}" if self.noise > 0.0 else "-"
        return f"sigma {self.sigma:.3g}: return {value}, signal {self.signal:.3g}, signal/noise {ratio}{lost}"


def piloted(config: RunConfig, stopped: Callable[[], bool] = lambda: False) -> RunConfig:
    """The configuration with the sigma that the pilot found, if it asks for one and has none yet.

    Raises:
      ConfigError: the task cannot start.
      Interrupted: the user stopped it; nothing has begun.
    """
    if not config.pilot or config.pilot_sigma is not None:
        return config
    log.info("a pilot measures how far to explore (--no-pilot: begin at once):")
    tried = []
    for each in ladder(config):
        if stopped():
            raise Interrupted("the pilot was stopped; nothing has begun")
        log.info("  %s", each.line)
        tried.append(each)
    sigma = chosen(tried)
    if sigma is None:
        log.info("  no sigma changes any return: the run begins as configured")
        sigma = float(getattr(config.algorithm_config, "initial_sigma"))  # noqa: B009
    log.info("the search begins with sigma %.3g", sigma)
    return replace(config, pilot_sigma=sigma)


def chosen(tried: Sequence[Tried]) -> float | None:
    """The sigma to begin with, of those tried, the largest first; None if none changes any return."""
    quiet = tried[-1]
    safe = [each for each in tried if each.lost <= quiet.lost + _MORE_LOST * 2 * PAIRS * STARTS]
    best = max(safe, key=lambda each: each.worth(quiet))
    return best.sigma if best.worth(quiet) > 0.0 else None


def ladder(config: RunConfig) -> Iterator[Tried]:
    """What exploring at each sigma gives, the largest first."""
    search = problem(config)
    algorithm: Any = config.algorithm_config
    largest = max(float(algorithm.initial_sigma), _LARGEST)
    mu = search.begin().mu
    directions = seeds.pilot(config.seed).standard_normal((PAIRS, mu.size))
    runner = search.runner()
    try:
        for share in _LADDER:
            yield _explored(runner, mu, largest * share, directions, config)
    finally:
        runner.close()


def _explored(runner: Runner, mu: FloatArray, sigma: float, directions: FloatArray, config: RunConfig) -> Tried:
    """What exploring around a mean (P,) along directions (K, P) at a sigma gives."""
    perturbed = config.task_config.perturb
    starts = [seeds.pilot_start(config.seed, start) for start in range(STARTS)] * PAIRS
    jobs = Jobs.exploring(np.repeat(sigma * directions, STARTS, axis=0), (1, -1), starts if perturbed else None)
    normaliser = NOT_NORMALISED
    if config.policy_config.normalise:
        few = jobs.take(list(range(2 * STARTS)))
        none = np.zeros(1 + 2 * runner.spec.observation)
        normaliser = np.stack([normaliser_of(none)] * 2)
        for _ in range(_NORMALISING):
            seen = runner.run(mu, few, "none", normaliser).moments
            normaliser = np.stack([normaliser_of(merged(none, seen))] * 2)
    results = runner.run(mu, jobs, "none", normaliser)
    returns = penalised(results.returns).reshape(PAIRS, STARTS, 2)
    differences = returns[:, :, 0] - returns[:, :, 1]
    if not known(results.returns).any():
        differences = np.zeros_like(differences)
    return Tried(
        sigma=sigma,
        returned=mean(results.returns),
        failed=int(np.count_nonzero(results.flags[:, 2])),
        ended=int(np.count_nonzero(results.flags[:, 1])),
        signal=float(differences.mean(axis=1).std()),
        noise=float(differences.std(axis=1).mean() / np.sqrt(STARTS)),
    )
