"""Spot checks: a second host repeats some jobs of a round. Pure: time is an argument [s].

Honest hosts return the same bits for the same job. In a mixed run this holds only for machines of
one kind, so only these are compared; devices are not checked. If two answers to a job differ, one
of the hosts is broken or lies. A judge decides which, if there is one, else two or more other hosts
that agree. Checks do not change any result.

Which jobs are checked follows from a generator that only the learner's process has, so no host can
tell. Each job has the same chance, larger for hosts that have passed few checks, and no host goes
without one for long. Most rounds choose when half of the round is done and every host has answered:
the checks are then handed out with the other half, and no worker waits for them. One round in four,
at random, chooses at its end, and late jobs then have four times the chance.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from learner.scheduler.round import RoundResults

_AT_THE_END: Final = 4  # one of so many rounds makes the choice at its end
_NEW: Final = 4.0  # times the share, for jobs of a host that has not earned trust
# Checks that earn it: of 3000 answers with one lie in 50, 240 miss all lies in 1 % of cases
_EARNED: Final = 240
_GAP: Final = 20  # rounds within which every host that answers is checked; a new host in each round
_STEP: Final = 8  # checks passed that add one round to this


class _Party(NamedTuple):
    """The workers of a host that round in the same way: they have the same canary."""

    host: str
    canary: str


@dataclass
class _Check:
    answers: dict[_Party, bytes]
    passed: set[str] = field(default_factory=set)
    """Hosts of which a worker was asked and did not answer in time."""
    asked: str = ""
    """The worker that has been asked and may still answer; empty if there is none."""
    since: float = 0.0

    @property
    def undecidable(self) -> bool:
        """Whether three hosts gave three answers: no further one can make it one against all
        others.
        """
        return len(set(self.answers.values())) > 2


@dataclass
class _Trust:
    passed: int = 0
    """Checks of its answers in which it was right."""
    since: int = 0
    """Rounds with answers of it since the last of them."""

    @property
    def due(self) -> bool:
        return self.since + 1 >= min(_GAP, 1 + self.passed // _STEP)


def host(worker: str) -> str:
    """The part of a worker's name that all workers of its host share."""
    return worker.partition("/")[0]


class Audit:
    """The spot checks of one round after another."""

    def __init__(
        self, part: float, rng: np.random.Generator, canary: Callable[[str], str] | None = None
    ) -> None:
        """Start without a round.

        Args:
          part: share of the jobs to check, 0 to 1; 0: none.
          rng: decides which; it must be a secret of this process, and touches no number of the run.
          canary: returns the digest of a worker's rounding, empty for a device; None: all workers
              round alike.
        """
        self._part, self._rng, self._best = part, rng, -np.inf
        self._canary = canary or (lambda _: "one")
        self._parties: list[_Party] = []
        self._numbers: dict[_Party, int] = {}  # their places in this list
        self._trust: dict[str, _Trust] = {}  # by host
        self._hosts: set[str] = set()  # that have answered in this round
        self.begin(0)

    def begin(self, jobs: int) -> None:
        """Start a round with this number of jobs."""
        # For each job the index in self._parties of the party whose answer was accepted; -1: not
        # checked.
        self._by = np.full(jobs, -1)
        self._checks: dict[int, _Check] = {}
        self._agreed: set[int] = set()
        self._right: set[str] = set()  # hosts that have passed a check of this round
        self._over = False
        self._unjudged: set[int] = set()  # jobs that the judge could not decide
        self._late = self._rng.random() * _AT_THE_END < 1.0  # whether this round chooses at its end
        self._first = np.zeros(jobs, dtype=bool)  # jobs that were done when half of the round was
        self._chosen = self._ended = False
        self._expected, self._hosts = len(self._hosts), set()

    @property
    def early(self) -> bool:
        """Whether `choose` is to be called now, if half of the round is done."""
        return self._part > 0 and not self._chosen and len(self._hosts) >= self._expected

    def counted(self, worker: str, indices: np.ndarray) -> None:
        """Note that this worker's answers to these jobs were accepted; a device's answers are
        not checked.
        """
        party = self._party(worker)
        if not party.canary:
            return
        if party not in self._numbers:
            self._numbers[party] = len(self._parties)
            self._parties.append(party)
        self._hosts.add(party.host)
        self._trust.setdefault(party.host, _Trust())
        self._by[indices] = self._numbers[party]

    def choose(self, results: RoundResults, workers: Sequence[str], *, end: bool) -> None:
        """Choose the jobs to check among those that are done, once in a round.

        Its end adds the job with the best return of the run so far, which is always checked.
        """
        if not self._part or self._ended or len({host(worker) for worker in workers}) < 2:
            return
        indices = self._choose(results, end=end)
        best, value = results.best() if end else (-1, -np.inf)
        if value > self._best and self._by[best] >= 0:
            indices.insert(0, best)
        for index in indices:
            if index not in self._agreed:
                self._checks.setdefault(index, _Check({self._whose(index): results.answer(index)}))
        self._chosen, self._ended = True, end

    def passed(self, results: RoundResults, workers: Sequence[str]) -> bool:
        """Whether a round with all jobs done needs no further checks."""
        self.choose(results, workers, end=True)
        if self._checks:
            return False
        if not self._over:
            self._over = True
            self._best = max(self._best, results.best()[1])
            for name in self._answered(self._by):
                self._trust[name].since += 1
            for name in self._right:
                self._trust[name].since = 0
        return True

    @property
    def passed_checks(self) -> dict[str, int]:
        """Number of checks that each host has passed, by name; of those only that have answered."""
        return {name: trust.passed for name, trust in sorted(self._trust.items())}

    @property
    def hosts(self) -> list[str]:
        """Hosts whose answers the round has accepted."""
        return self._answered(self._by)

    def owed(self) -> dict[str, int]:
        """After a round: hosts whose check is due but was not possible, each with one of its
        jobs.
        """
        if not self._part:
            return {}
        names = [
            name
            for name in self._answered(self._by)
            if self._trust[name].since and self._trust[name].due
        ]
        return {name: int(self._rng.choice(self._jobs_of(name))) for name in names}

    def unchecked(self, name: str) -> bool:
        """Whether a host has answered in a round since its last check."""
        return self._trust[name].since > 0

    def canary_of(self, index: int) -> str:
        """The canary of the worker whose answer to a job was accepted."""
        return self._whose(index).canary

    def credit(self, name: str) -> None:
        """A host was right in a check that was made elsewhere."""
        self._trust[name].passed += 1
        self._trust[name].since = 0

    def answered(self, worker: str, index: int, first: bytes, second: bytes) -> bool:
        """Take another answer to a job that is done; return whether a check had asked this
        worker for it.
        """
        party, check = self._party(worker), self._checks.get(index)
        expected = check is not None and check.asked == worker
        if not self._part or self._by[index] < 0 or (check is None and first == second):
            return expected
        whose = self._whose(index)
        if party == whose or party.canary != whose.canary:
            return expected
        check = self._checks.setdefault(index, _Check({whose: first}))
        check.answers.setdefault(party, second)
        check.asked = ""
        return expected

    def settle(self, judge: Callable[[int, str], bytes | None] | None = None) -> dict[str, int]:
        """Close the checks in which two hosts agree; return each host that disagreed, and the job.

        Args:
          judge: returns the right answer to a job, as machines with this canary compute it, or None
            if it cannot. It is asked only if two answers differ. Without an answer, two hosts or
            more decide against one.
        """
        liars: dict[str, int] = {}
        for index, check in list(self._checks.items()):
            if len(check.answers) < 2:
                continue
            counts = Counter(check.answers.values()).most_common()
            answer = counts[0][0]
            if len(counts) > 1:
                truth = (
                    judge(index, self._whose(index).canary)
                    if judge and index not in self._unjudged
                    else None
                )
                if truth is None:
                    self._unjudged.add(index)
                answer = answer if truth is None else truth
                if truth is None and (len(counts) > 2 or counts[0][1] < 2 or counts[1][1] > 1):
                    continue
            whose = self._whose(index)
            # Told to its author only: who repeats a job may know that it is a check
            if check.answers.get(whose) == answer:
                self._trust[whose.host].passed += 1
                self._right.add(whose.host)
            liars |= {
                party.host: index for party, other in check.answers.items() if other != answer
            }
            self._agreed.add(index)
            del self._checks[index]
        return liars

    def expel(self, name: str) -> list[int]:
        """Discard a host's answers; return its jobs of this round, which must be repeated."""
        parties = [at for at, party in enumerate(self._parties) if party.host == name]
        jobs = np.flatnonzero(np.isin(self._by, parties)).tolist()
        self._by[jobs] = -1
        self._trust[name] = _Trust()
        self._right.discard(name)
        self._agreed.difference_update(jobs)
        for index in jobs:
            self._checks.pop(index, None)
        for check in self._checks.values():
            check.answers = {
                party: answer for party, answer in check.answers.items() if party.host != name
            }
        self._chosen = self._ended = False
        return jobs

    def lost(self, worker: str) -> None:
        """A worker has left, or is idle: its checks go to a different worker."""
        for check in self._checks.values():
            if check.asked == worker:
                check.asked = ""

    def due(self, now: float, patience: float) -> bool:
        """Whether `assign` has a check to send."""
        return any(
            not (check.asked or check.undecidable) or (check.asked and now - check.since > patience)
            for check in self._checks.values()
        )

    def assign(self, workers: Sequence[str], now: float, patience: float) -> dict[str, list[int]]:
        """Return the jobs to send now, by worker: of those that can answer, one after another.

        A check that no worker can answer is dropped, unless two answers differ; then it waits for
        one.
        """
        assignments: dict[str, list[int]] = {}
        queue = deque((name, self._party(name)) for name in workers)
        for index, check in list(self._checks.items()):
            if check.asked and now - check.since > patience:
                check.passed.add(host(check.asked))
                check.asked = ""
            if check.asked or check.undecidable:
                continue
            hosts, canary = {party.host for party in check.answers}, self._whose(index).canary
            for _ in range(len(queue)):
                name, party = queue[0]
                queue.rotate(-1)
                if party.canary == canary and party.host not in hosts | check.passed:
                    check.asked, check.since = name, now
                    assignments.setdefault(name, []).append(index)
                    break
            if check.asked:
                continue
            if len(check.answers) < 2:
                del self._checks[index]
            else:
                check.passed.clear()
        return assignments

    @property
    def disputed(self) -> str:
        """Hosts whose answers differ while no host can decide; empty if there are none."""
        unasked = (
            check for check in self._checks.values() if len(check.answers) > 1 and not check.asked
        )
        return next((" and ".join(party.host for party in check.answers) for check in unasked), "")

    def _party(self, worker: str) -> _Party:
        return _Party(host(worker), self._canary(worker))

    def _whose(self, index: int) -> _Party:
        return self._parties[self._by[index]]

    def _answered(self, by: np.ndarray) -> list[str]:
        """The hosts of these parties, in order."""
        return list(dict.fromkeys(self._parties[at].host for at in sorted({*by.tolist()} - {-1})))

    def _jobs_of(self, name: str) -> np.ndarray:
        mask = np.array([*(party.host == name for party in self._parties), False])  # -1: nobody's
        return np.flatnonzero(mask[self._by])

    def _choose(self, results: RoundResults, *, end: bool) -> list[int]:
        """The jobs that are drawn; and of each host that is due its best and another, if none of
        the others is.
        """
        done, chance = self._by >= 0, np.zeros(len(self._by))
        if not end:
            self._first = done
        # A round may end without ever being half done
        if not end and not self._late or end and not self._chosen:
            chance[done] = self._part
        elif end and self._late:
            chance[done] = np.where(self._first, 1.0, _AT_THE_END)[done] * self._part
        new = [self._trust[party.host].passed < _EARNED for party in self._parties]
        chance[done] *= np.where(np.array(new, dtype=bool)[self._by[done]], _NEW, 1.0)
        indices = np.flatnonzero(self._rng.random(len(chance)) < chance).tolist()
        if self._late and not end:
            return indices
        returns = results.job_returns()
        checked = {self._whose(index).host for index in self._checks} | self._right
        for name in self._answered(self._by):
            if not self._trust[name].due or name in checked:
                continue
            jobs = self._jobs_of(name)
            best = int(jobs[returns[jobs].argmax()])
            others = jobs[jobs != best]
            if not set(indices).intersection(others.tolist()):
                indices += [int(self._rng.choice(others)), best] if len(others) else [best]
        return indices
