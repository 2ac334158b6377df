"""Says when a run does not learn, and what to try.

Pure: from the statistics of its generations alone.
"""

from collections import deque
from collections.abc import Iterator
from typing import Final

import numpy as np

from farm.net.stats import GenerationStats

WINDOW: Final = 10
"""Generations over which the mean policy's return is averaged."""

STALE: Final = 100
"""Generations without a better average after which a run does not improve."""

FALLEN: Final = 20
"""Successive generations with a low average after which a run has fallen."""

REPEATED: Final = 3
"""Successive generations of equal returns, or of rollouts of one step, that count."""

_SHRUNK: Final = 1e-3  # of the initial sigma; for algorithms without a floor
_WORSE: Final = 0.05  # of the best average return: a smaller fall is not worth a message
_NOISE: Final = 3.0  # standard deviations of the mean policy's return that a fall exceeds


class Diagnosis:
    """Diagnosis of what is wrong with a run's learning, by its generations so far.

    Each message is given once.
    """

    def __init__(self, algorithm: object) -> None:
        """Begin a run with these settings of its algorithm."""
        self._floor = getattr(
            algorithm, "sigma_floor", _SHRUNK * getattr(algorithm, "initial_sigma", 0.0)
        )
        self._window: deque[float] = deque(maxlen=WINDOW)
        # Averages over a window, and the deviation in the best one
        self._first = self._best = self._noise = -np.inf
        self._best_at = 0  # a generation
        self._low = self._equal = self._short = 0  # lengths of unbroken rows
        self._given: set[str] = set()

    def after(self, stats: GenerationStats, *, one_step: bool = False) -> list[str]:
        """New messages after a generation; `one_step`: all its rollouts ended in the first of
        several steps.
        """
        if stats.mean_policy_return is not None:
            self._window.append(stats.mean_policy_return)
        sound = not stats.failed  # instability has a message of its own
        self._equal = self._equal + 1 if sound and stats.return_min == stats.return_max else 0
        self._short = self._short + 1 if sound and one_step else 0
        new = {kind: message for kind, message in self._found(stats) if kind not in self._given}
        self._given |= set(new)
        return list(new.values())

    def _found(self, stats: GenerationStats) -> Iterator[tuple[str, str]]:
        if self._short >= REPEATED:
            yield (
                "short",
                (
                    f"all rollouts of {REPEATED} generations ended in their first step: look at how"
                    " the task starts and what ends it; farm check draws the start"
                ),
            )
        elif self._equal >= REPEATED:
            yield (
                "equal",
                (
                    f"all rollouts of {REPEATED} generations returned {stats.return_max:.4g}: no"
                    " perturbation changes the reward; look at observe and reward (farm check),"
                    " then try a larger --initial-sigma"
                ),
            )
        unsolved = stats.mean_policy_return is not None and not stats.mean_policy_success
        if unsolved and len(self._window) == WINDOW:
            yield from self._course(stats)

    def _course(self, stats: GenerationStats) -> Iterator[tuple[str, str]]:
        """Look at the mean policy's returns so far; a run that succeeds may stay where it is."""
        if stats.sigma_max <= self._floor:
            yield (
                "sigma",
                (
                    f"sigma is down to {stats.sigma_max:.3g}: the search does not explore any more;"
                    " try a larger --initial-sigma, or a smaller --learning-rate-sigma"
                ),
            )
        now = float(np.mean(self._window))
        if self._first == -np.inf:
            self._first = now
        if now > self._best:
            self._best = now
            self._best_at = stats.generation
            self._noise = float(np.std(self._window))
        fall = max((self._best - self._first) / 2.0, _NOISE * self._noise, _WORSE * abs(self._best))
        self._low = self._low + 1 if self._best - now > fall > 0.0 else 0
        where = f"{self._best:.4g} around generation {self._best_at}"
        if self._low >= FALLEN:
            yield (
                "fall",
                (
                    f"the mean policy has become worse: it returned {where}, now {now:.4g}; the"
                    " steps are too large: try a smaller --learning-rate-mu, then a smaller"
                    " --initial-sigma or more --pairs"
                ),
            )
        elif stats.generation - self._best_at >= STALE:
            yield (
                "stale",
                (
                    f"the mean policy has not improved for {STALE} generations: it returned"
                    f" {where}, now {now:.4g}; if that is too little, try more --pairs, a larger"
                    " --initial-sigma, or another policy (farm tune)"
                ),
            )
