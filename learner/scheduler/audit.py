"""Spot checks: a second host repeats some jobs of a round. Pure: time is an argument [s].

Honest hosts return the same bits for the same job. In a mixed run this holds only for machines of one kind, so only
these are compared; devices are not checked. If two answers to a job differ, one of the hosts is broken or lies, and
a third host's answer decides which. Checks do not change any result.

Most rounds choose the jobs to check when half of the round is done and every host has answered: the checks are then
handed out with the other half, and no worker waits for them. Every fourth round chooses at its end, so that late jobs
are checked too.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from learner.scheduler.round import RoundResults

_AT_THE_END: Final = 4  # every so many rounds the choice is made at the end


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
        self._numbers: dict[_Party, int] = {}  # their places in this list
        self._checked: dict[_Party, int] = {}  # the round in which a party's best job was checked last
        self._hosts: set[str] = set()  # that have answered in this round
        self.begin(0)

    def begin(self, jobs: int) -> None:
        """Start a round with this number of jobs."""
        self._round += 1
        # For each job the index in self._parties of the party whose answer was accepted; -1: not checked.
        self._by = np.full(jobs, -1)
        self._checks: dict[int, _Check] = {}
        self._agreed: set[int] = set()
        self._chosen = self._ended = False
        self._expected, self._hosts = len(self._hosts), set()

    @property
    def on(self) -> bool:
        """Whether anything is checked."""
        return self._part > 0

    @property
    def early(self) -> bool:
        """Whether this round's jobs to check are to be chosen now, if half of the round is done."""
        early = self.on and not self._chosen and self._round % _AT_THE_END != 0
        return early and len(self._hosts) >= self._expected

    def counted(self, worker: str, indices: np.ndarray) -> None:
        """Note that this worker's answers to these jobs were accepted; a device's answers are not checked."""
        party = self._party(worker)
        if not party.canary:
            return
        if party not in self._numbers:
            self._numbers[party] = len(self._parties)
            self._parties.append(party)
        self._hosts.add(party.host)
        self._by[indices] = self._numbers[party]

    def choose(self, results: RoundResults, workers: Sequence[str], *, end: bool) -> None:
        """Choose the jobs to check among those that are done, once in a round.

        Its end adds the job with the best return of the run so far, which is always checked.
        """
        if not self.on or self._ended or len({host(worker) for worker in workers}) < 2:
            return
        chosen = [] if self._chosen else self._choose(results)
        best, value = results.best() if end else (-1, -np.inf)
        if value > self._best and self._by[best] >= 0:
            chosen.insert(0, best)
        for index in chosen:
            if index not in self._agreed:
                self._checks.setdefault(index, _Check({self._whose(index): results.answer(index)}))
        self._chosen, self._ended = True, end

    def passed(self, results: RoundResults, workers: Sequence[str]) -> bool:
        """Whether a round with all jobs done needs no further checks."""
        self.choose(results, workers, end=True)
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
            if len(check.answers) < 2:
                continue
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
        self._chosen = self._ended = False
        return jobs

    def lost(self, worker: str) -> None:
        """A worker has left, or is idle: its checks go to a different worker."""
        for check in self._checks.values():
            if check.asked == worker:
                check.asked = ""

    def due(self, now: float, patience: float) -> bool:
        """Whether `assign` has a check to send."""
        return any(not check.asked or now - check.since > patience for check in self._checks.values())

    def assign(self, workers: Sequence[str], now: float, patience: float) -> dict[str, list[int]]:
        """Return the jobs to send now, by worker: of those that can answer, one after another.

        A check that no worker can answer is dropped, unless two answers differ; then it waits for one.
        """
        asked: dict[str, list[int]] = {}
        queue = deque((name, self._party(name)) for name in workers)
        for index, check in list(self._checks.items()):
            if check.asked and now - check.since > patience:
                check.passed.add(check.asked)
                check.asked = ""
            if check.asked:
                continue
            hosts, canary = {party.host for party in check.answers}, self._whose(index).canary
            for _ in range(len(queue)):
                name, party = queue[0]
                queue.rotate(-1)
                if party.canary == canary and party.host not in hosts and name not in check.passed:
                    check.asked, check.since = name, now
                    asked.setdefault(name, []).append(index)
                    break
            if check.asked:
                continue
            if len(check.answers) < 2:
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
        """A round's share of jobs: the best of each host, those not checked for longest first; then others by index."""
        jobs = len(self._by)
        count = int((self._round + 1) * self._part * jobs) - int(self._round * self._part * jobs)
        returns, checked = results.job_returns(), self._by >= 0
        there = sorted(np.unique(self._by[checked]).tolist(), key=lambda by: self._checked.get(self._parties[by], -1))
        self._checked |= {self._parties[by]: self._round for by in there[:count]}
        best = [int(np.where(self._by == by, returns, -np.inf).argmax()) for by in there[:count]]
        mixed = (np.arange(jobs, dtype=np.uint64) + 1 + self._round * jobs) * np.uint64(0x9E3779B97F4A7C15)
        order = np.argsort(mixed, kind="stable")
        return list(dict.fromkeys([*best, *order[checked[order]].tolist()]))[:count]
