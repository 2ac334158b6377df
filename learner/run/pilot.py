"""A pilot: measures, before a run begins, how far its search may explore.

No size of the first perturbations fits all robots: one that barely moves an arm topples a standing
robot. So K pairs mu +- sigma e_k, e_k ~ N(0, I), are simulated from the same S starts as mu itself,
with the configured sigma, then with a third of it, and so on, until exploring costs little:

    r_0 - r <= 6 signal,
    signal = std over k of the mean over s of r(mu + sigma e_k, s) - r(mu - sigma e_k, s),

where r_0 is the mean return of mu, and r that of the perturbed policies: exploring does not cost
much more than it tells about directions. And if mu mostly lasts, hardly more rollouts may end early
or fail than with it: a robot that stands must not learn from its falls. The directions e_k are the
same for each sigma.

If the configured sigma costs little, three times as much is tried too, and taken if the perturbed
policies return more with it and its signal is larger by a tenth: with a reward that the first
policies hardly see, only those that go far find it.

It is simulated by processes of this machine, not by the run's workers: a run has it before it
exists.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import FloatArray
from farm.errors import Interrupted
from farm.moments import merged, normaliser_of
from farm.net.work import NOT_NORMALISED, Jobs, Simulated
from farm.returns import known, mean, penalised
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.parallel import ParallelRunner
from learner.run.setup import beginning, origin_of

log = logging.getLogger(__name__)

PAIRS: Final = 8
"""Directions, K."""

STARTS: Final = 4
"""Starts that all of them share, S."""

_STEP: Final = 10.0**-0.5  # from one sigma to the next
_SIGMAS: Final = 6  # that are tried at most
_COST: Final = 6.0  # signals that exploring may cost
_LOST: Final = 0.1  # share of the rollouts that may end early or fail beyond those of the mean
_LASTS: Final = 0.5  # a mean of which less than this share does so has something to lose
_CLEARLY: Final = 1.1  # times the signal before
_MEAN: Final = 16  # rollouts of the mean, the first STARTS of them from the shared starts
# Rounds in which the normaliser settles to what exploring at a sigma observes
_NORMALISING: Final = 2


@dataclass(frozen=True)
class Tried:
    """Result of the mean (sigma 0), or of exploring at a sigma."""

    sigma: float
    returned: float | None
    """Mean return of the rollouts that have one."""
    lost: float
    """Share of the rollouts that ended early or failed."""
    signal: float = 0.0
    """How much returns differ between directions."""

    def fits(self, mean: "Tried") -> bool:
        """Whether a search may explore so far from a mean."""
        if self.returned is None or (mean.lost < _LASTS and self.lost > mean.lost + _LOST):
            return False
        return mean.returned is None or mean.returned - self.returned <= _COST * self.signal

    def gains(self, before: "Tried") -> bool:
        """Whether exploring so far returns more, and tells clearly more, than something before."""
        if self.returned is None or before.returned is None:
            return False
        return self.returned > before.returned and self.signal > _CLEARLY * before.signal

    @property
    def line(self) -> str:
        """Result in words."""
        value = "-" if self.returned is None else f"{self.returned:.4g}"
        signal = f", signal {self.signal:.3g}" if self.sigma else ""
        losses = f", {self.lost:.0%} end early or fail" if self.lost else ""
        return f"sigma {self.sigma:.3g}: return {value}{signal}{losses}"


def piloted(
    config: RunConfig,
    stopped: Callable[[], bool] = lambda: False,
    *,
    processes: int = 1,
    awaited: bool = False,
) -> RunConfig:
    """The configuration with the sigma that the pilot found, if it asks for one and has none yet.

    A run that goes on from another one of the same task (`init_from`) has that one's sigma, and
    steps of the size that the other one's pilot found.

    Args:
      config: of the run.
      stopped: whether the user has asked to stop.
      processes: that simulate, at most; the result is the same for any number.
      awaited: workers from elsewhere can join only after it, which it says.

    Raises:
      ConfigError: the task cannot start, or the run to go on from cannot be used.
      Interrupted: the user stopped it; nothing has begun.
    """
    if not config.pilot or config.pilot_sigma is not None:
        return config
    origin = origin_of(config)
    if origin is not None and not origin.scale_begins_anew:
        sigma = origin.config.pilot_sigma
        return config if sigma is None else replace(config, pilot_sigma=sigma)
    joining = "; workers can join after it" if awaited else ""
    log.info("a pilot measures how far to explore%s (--no-pilot: begin at once)", joining)
    trials = []
    try:
        for each in tried(config, stopped, processes):
            log.info("  %s", each.line)
            trials.append(each)
    except Interrupted:
        raise Interrupted("the pilot was stopped; nothing has begun") from None
    sigma = choice(trials)
    log.info("  the run begins with sigma %.3g", sigma)
    return replace(config, pilot_sigma=sigma)


def choice(trials: Sequence[Tried]) -> float:
    """The sigma that is taken of those that `tried` gives: the last one, unless it is larger and
    gains nothing.
    """
    first = trials[1]
    last = trials[-1]
    return first.sigma if last.sigma > first.sigma and not last.gains(first) else last.sigma


def begun(config: RunConfig, folder: RunFolder) -> RunConfig:
    """The configuration of a run that goes on, with what its pilot found."""
    if not config.pilot or config.pilot_sigma is not None:
        return config
    return replace(config, pilot_sigma=folder.read_config().pilot_sigma)


def tried(
    config: RunConfig, stopped: Callable[[], bool] = lambda: False, processes: int = 1
) -> Iterator[Tried]:
    """What the mean gives, and exploring at each sigma: the last one fits, or is the smallest.

    If the first fits, the only other is a larger one. Arguments as in `piloted`.

    Raises:
      Interrupted: the user asked to stop.
    """
    search, state, moments = beginning(config)
    algorithm: Any = config.algorithm_config
    mu = state.mu
    directions = seeds.pilot(config.seed).standard_normal((PAIRS, mu.size))
    with closing(ParallelRunner(search, processes, stopped)) as runner:
        first = _normaliser(config, moments)
        results = runner.run(mu, Jobs.mean("none", _starts(config, _MEAN)), first)
        base = replace(_summed(0.0, results), returned=mean(results.returns[:STARTS]))
        yield base
        for step in range(_SIGMAS):
            sigma = float(algorithm.initial_sigma) * _STEP**step
            each = _explored(runner, mu, sigma, directions, moments, config)
            yield each
            if each.fits(base):
                if not step:
                    yield _explored(runner, mu, sigma / _STEP, directions, moments, config)
                return


def _starts(config: RunConfig, count: int = STARTS) -> list[tuple[int, ...] | None]:
    return [
        seeds.pilot_start(config.seed, i) if config.task_config.perturb else None
        for i in range(count)
    ]


def _normaliser(
    config: RunConfig,
    moments: FloatArray,
    later: FloatArray | None = None,
) -> FloatArray:
    """Normaliser of a RoundHeader, (2, 2, d).

    Args:
      config: of the run.
      moments: of the observations with which it begins, (1 + 2 d,).
      later: moments of the observations of the first rollouts, (S, 1 + 2 d).
    """
    if not config.policy_config.normalise:
        return NOT_NORMALISED
    return np.stack([normaliser_of(moments if later is None else merged(moments, later))] * 2)


def _explored(
    runner: ParallelRunner,
    mu: FloatArray,
    sigma: float,
    directions: FloatArray,
    moments: FloatArray,
    config: RunConfig,
) -> Tried:
    """What exploring around a mean (P,) along directions (K, P) at a sigma gives."""
    starts = _starts(config) * PAIRS
    eps = np.repeat(sigma * directions, STARTS, axis=0)
    perturbed = [start for start in starts if start is not None]
    jobs = Jobs.exploring(eps, (1, -1), perturbed or None)
    normaliser = _normaliser(config, moments)
    if config.policy_config.normalise:
        few = jobs.take(list(range(2 * STARTS)))
        for _ in range(_NORMALISING):
            later = runner.run(mu, few, normaliser).moments
            normaliser = _normaliser(config, moments, later)
    results = runner.run(mu, jobs, normaliser)
    if not known(results.returns).any():
        return _summed(sigma, results)
    returns = penalised(results.returns).reshape(PAIRS, STARTS, 2)
    differences = (returns[:, :, 0] - returns[:, :, 1]).mean(axis=1)
    return replace(_summed(sigma, results), signal=float(differences.std()))


def _summed(sigma: float, results: Simulated) -> Tried:
    failures = results.flags[:, 1] | results.flags[:, 2] | results.flags[:, 3]
    return Tried(sigma=sigma, returned=mean(results.returns), lost=float(failures.mean()))
