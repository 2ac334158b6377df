"""Spot checks: a second host repeats some jobs of a round. Pure: time is an argument [s].

Honest hosts return the same bits for the same job. In a mixed run this holds only for machines of one kind, so only
these are compared; devices are not checked. If two answers to a job differ, one of the hosts is broken or lies, and
a third host's answer decides which. The choice of jobs depends on the round, the indices and the returns, never on
the clock. Checks do not change any result.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from learner.scheduler.round import RoundResults


class _Party(NamedTuple):
    """The workers of a host that round in the same way: they have the same canary."""

    host: str
    canary: str


@dataclass
class _Check:
    answers: dict[_Party, bytes]
    passed: set[str] = field(default_factory=set)
    """Workers that were asked and did not answer in time."""
    asked: str = ""
    """The worker that has been asked and may still answer; empty if there is none."""
    since: float = 0.0


def host(worker: str) -> str:
    """The part of a worker's name that all workers of its host share."""
    return worker.partition("/")[0]


class Audit:
    """The spot checks of one round after another."""

    def __init__(self, part: float, canary: Callable[[str], str] | None = None) -> None:
        """Start without a round.

        Args:
          part: share of the jobs to check, 0 to 1; 0: none.
          canary: returns the digest of a worker's rounding, empty for a device; None: all workers round alike.
        """
        self._part, self._round, self._best = part, -1, -np.inf
        self._canary = canary or (lambda _: "one")
        self._parties: list[_Party] = []
        self.begin(0)

    def begin(self, jobs: int) -> None:
        """Start a round with this number of jobs."""
        self._round += 1
        # For each job the index in self._parties of the party whose answer was accepted; -1: not checked.
        self._by = np.full(jobs, -1)
        self._checks: dict[int, _Check] = {}
        self._agreed: set[int] = set()
        self._chosen = False

    @property
    def on(self) -> bool:
        """Whether anything is checked."""
        return self._part > 0

    def counted(self, worker: str, indices: np.ndarray) -> None:
        """Note that this worker's answers to these jobs were accepted; a device's answers are not checked."""
        party = self._party(worker)
        if not party.canary:
            return
        if party not in self._parties:
            self._parties.append(party)
        self._by[indices] = self._parties.index(party)

    def passed(self, results: RoundResults, workers: Sequence[str]) -> bool:
        """Whether a round with all jobs done needs no further checks; the first call chooses the jobs to check."""
        if self.on and not self._chosen and len({host(worker) for worker in workers}) > 1:
            self._chosen = True
            for index in self._choose(results):
                if index not in self._agreed:
                    self._checks.setdefault(index, _Check({self._whose(index): results.answer(index)}))
        if self._checks:
            return False
        self._best = max(self._best, results.best()[1])
        return True

    def answered(self, worker: str, index: int, first: bytes, second: bytes) -> bool:
        """Take another answer to a job that is done; return whether a check had asked this worker for it."""
        party, known = self._party(worker), self._checks.get(index)
        asked = known is not None and known.asked == worker
        if not self.on or self._by[index] < 0 or (known is None and first == second):
            return asked
        whose = self._whose(index)
        if party == whose or party.canary != whose.canary:
            return asked
        check = self._checks.setdefault(index, _Check({whose: first}))
        check.answers.setdefault(party, second)
        check.asked = ""
        return asked

    def settle(self) -> dict[str, int]:
        """Close the checks in which two hosts agree; return each host that disagreed, and the job."""
        liars: dict[str, int] = {}
        for index, check in list(self._checks.items()):
            answer, agree = Counter(check.answers.values()).most_common(1)[0]
            if agree > 1:
                liars |= {party.host: index for party, other in check.answers.items() if other != answer}
                self._agreed.add(index)
                del self._checks[index]
        return liars

    def expel(self, name: str) -> list[int]:
        """Discard a host's answers; return its jobs of this round, which must be repeated."""
        theirs = [at for at, party in enumerate(self._parties) if party.host == name]
        jobs = np.flatnonzero(np.isin(self._by, theirs)).tolist()
        self._by[jobs] = -1
        self._agreed.difference_update(jobs)
        for index in jobs:
            self._checks.pop(index, None)
        for check in self._checks.values():
            check.answers = {party: answer for party, answer in check.answers.items() if party.host != name}
        self._chosen = False
        return jobs

    def lost(self, worker: str) -> None:
        """A worker has left, or is idle: its checks go to a different worker."""
        for check in self._checks.values():
            if check.asked == worker:
                check.asked = ""

    def assign(self, workers: Sequence[str], now: float, patience: float) -> dict[str, list[int]]:
        """Return the jobs to send now, by worker.

        A check that no worker can answer is dropped, unless two answers differ; then it waits for one.
        """
        asked: dict[str, list[int]] = {}
        parties = {name: self._party(name) for name in workers} if self._checks else {}
        for index, check in list(self._checks.items()):
            if check.asked and now - check.since > patience:
                check.passed.add(check.asked)
                check.asked = ""
            if check.asked:
                continue
            hosts, canary = {party.host for party in check.answers}, self._whose(index).canary
            free = [
                name for name, party in parties.items()
                if party.canary == canary and party.host not in hosts and name not in check.passed
            ]  # fmt: skip
            if free:
                check.asked, check.since = min(free, key=lambda name: len(asked.get(name, ()))), now
                asked.setdefault(check.asked, []).append(index)
            elif len(check.answers) < 2:
                del self._checks[index]
            else:
                check.passed.clear()
        return asked

    @property
    def disputed(self) -> str:
        """Hosts whose answers differ while there is no third host to decide; empty if there are none."""
        unasked = (check for check in self._checks.values() if len(check.answers) > 1 and not check.asked)
        return next((" and ".join(party.host for party in check.answers) for check in unasked), "")

    def _party(self, worker: str) -> _Party:
        return _Party(host(worker), self._canary(worker))

    def _whose(self, index: int) -> _Party:
        return self._parties[self._by[index]]

    def _choose(self, results: RoundResults) -> list[int]:
        """The best job of the run so far, always; then the best job of each host in turn, and some of the others."""
        jobs = len(self._by)
        count = int((self._round + 1) * self._part * jobs) - int(self._round * self._part * jobs)
        returns = results.job_returns()
        checked = self._by >= 0
        order = [int(np.where(self._by == by, returns, -np.inf).argmax()) for by in np.unique(self._by[checked])]
        turn = self._round % max(1, len(order))
        order = order[turn:] + order[:turn]
        mixed = (np.arange(jobs, dtype=np.uint64) + 1 + self._round * jobs) * np.uint64(0x9E3779B97F4A7C15)
        chosen = list(dict.fromkeys([*order, *np.argsort(mixed, kind="stable").tolist()]))[:count]
        best, value = results.best()
        return [job for job in ([best, *chosen] if value > self._best else chosen) if checked[job]]
