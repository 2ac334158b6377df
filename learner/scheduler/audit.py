"""Spot checks: some jobs of a round are done by a second host as well. Pure: time is an argument [s].

Honest hosts of one run give the same bits. Two answers to a job that differ mean that one of the hosts is broken or
lies, and a third host's answer says which. Which jobs are checked depends on the round, the indices and the returns,
never on the clock; that they are checked changes no number.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from learner.scheduler.round import RoundResults


@dataclass
class _Check:
    answers: dict[str, bytes]
    """By host."""
    passed: set[str] = field(default_factory=set)
    """Workers that were asked and did not answer in time."""
    asked: str = ""
    """The worker that is asked now."""
    since: float = 0.0


def host(worker: str) -> str:
    """The name that a worker's processes share."""
    return worker.partition("/")[0]


class Audit:
    """The spot checks of one round after another."""

    def __init__(self, part: float) -> None:
        """Check this part of the jobs, 0 to 1; 0: none at all."""
        self._part, self._round, self._best = part, -1, -np.inf
        self._hosts: list[str] = []
        self.begin(0)

    def begin(self, jobs: int) -> None:
        """A round of so many jobs."""
        self._round += 1
        self._by = np.full(jobs, -1)  # whose answer counts, as a place in self._hosts
        self._checks: dict[int, _Check] = {}
        self._agreed: set[int] = set()
        self._chosen = False

    @property
    def on(self) -> bool:
        """Whether anything is checked."""
        return self._part > 0

    def counted(self, worker: str, indices: np.ndarray) -> None:
        """These answers of a worker are the ones that count."""
        name = host(worker)
        if name not in self._hosts:
            self._hosts.append(name)
        self._by[indices] = self._hosts.index(name)

    def passed(self, results: RoundResults, workers: Sequence[str]) -> bool:
        """Whether the round, all of whose jobs are done, needs no further answer; chooses what to check at first."""
        if self.on and not self._chosen and len({host(worker) for worker in workers}) > 1:
            self._chosen = True
            for index in self._choose(results):
                if index not in self._agreed:
                    self._checks.setdefault(index, _Check({self._name(index): results.answer(index)}))
        if self._checks:
            return False
        self._best = max(self._best, results.best()[1])
        return True

    def answered(self, worker: str, index: int, first: bytes, second: bytes) -> bool:
        """Another answer to a job that is done; return whether it was asked for, not given to two workers anyway."""
        name, known = host(worker), self._checks.get(index)
        asked = known is not None and known.asked == worker
        if not self.on or name == self._name(index) or (known is None and first == second):
            return asked
        check = self._checks.setdefault(index, _Check({self._name(index): first}))
        check.answers.setdefault(name, second)
        check.asked = ""
        return asked

    def settle(self) -> dict[str, int]:
        """Close the checks in which two hosts agree; who said something else, and at which job."""
        liars: dict[str, int] = {}
        for index, check in list(self._checks.items()):
            answer, agree = Counter(check.answers.values()).most_common(1)[0]
            if agree > 1:
                liars |= {name: index for name, other in check.answers.items() if other != answer}
                self._agreed.add(index)
                del self._checks[index]
        return liars

    def expel(self, name: str) -> list[int]:
        """A host's answers count no longer; its jobs of this round, to be done again."""
        jobs = np.flatnonzero(self._by == self._hosts.index(name)).tolist() if name in self._hosts else []
        self._by[jobs] = -1
        self._agreed.difference_update(jobs)
        for index in jobs:
            self._checks.pop(index, None)
        for check in self._checks.values():
            check.answers.pop(name, None)
        self._chosen = False
        return jobs

    def lost(self, worker: str) -> None:
        """A worker is gone, or holds nothing any more: what it was asked is asked of another."""
        for check in self._checks.values():
            if check.asked == worker:
                check.asked = ""

    def assign(self, workers: Sequence[str], now: float, patience: float) -> dict[str, list[int]]:
        """Whom to ask what now. A check that nobody can answer is dropped, unless two answers differ: that waits."""
        asked: dict[str, list[int]] = {}
        for index, check in list(self._checks.items()):
            if check.asked and now - check.since > patience:
                check.passed.add(check.asked)
                check.asked = ""
            if check.asked:
                continue
            free = [name for name in workers if host(name) not in check.answers and name not in check.passed]
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
        """Hosts whose answers differ, as long as no third host can settle it; empty where none do."""
        return next((" and ".join(c.answers) for c in self._checks.values() if len(c.answers) > 1 and not c.asked), "")

    def _name(self, index: int) -> str:
        return self._hosts[self._by[index]]

    def _choose(self, results: RoundResults) -> list[int]:
        """The best of the run so far, always; then each host's best, in turn, and some of the rest."""
        jobs = len(self._by)
        count = int((self._round + 1) * self._part * jobs) - int(self._round * self._part * jobs)
        returns = results.job_returns()
        order = [int(np.where(self._by == by, returns, -np.inf).argmax()) for by in np.unique(self._by)]
        turn = self._round % len(order)
        order = order[turn:] + order[:turn]
        mixed = (np.arange(jobs, dtype=np.uint64) + 1 + self._round * jobs) * np.uint64(0x9E3779B97F4A7C15)
        chosen = list(dict.fromkeys([*order, *np.argsort(mixed, kind="stable").tolist()]))[:count]
        best, value = results.best()
        return [best, *chosen] if value > self._best else chosen
