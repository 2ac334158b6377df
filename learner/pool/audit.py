"""Which answers of other machines are checked: a checker repeats their jobs, and is right by
definition. Pure.

Honest hosts return the same bits for the same job, so a host whose answer differs is broken or
lies. Which answers are checked follows from a generator that only the learner's process has, and
no host sees a check. Checks do not change any result, and no round waits for one: they may be made
a generation later, as a run goes back to before the first answer of a host that turns out wrong.

Three kinds, in this order: each new best rollout; one answer of each host whose check is due, kept
until it is made; and a share of all others, of which those that a slow checker has not begun by
the end of the next round are left out.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np

from farm.net.work import Jobs, RoundHeader
from learner.pool.round import RoundResults

_NEW: Final = 4.0  # times the share, for jobs of a host that has not earned trust
# Checks that earn it: of 3000 answers with one lie in 50, 240 miss all lies in 1 % of cases
_EARNED: Final = 240
# Every host is due at least once in this many rounds; new hosts in every round
_GAP: Final = 20
_STEP: Final = 8  # checks passed that add one round to this

Finding: TypeAlias = Literal["right", "wrong", "unknown"]
"""What the checker says of an answer; `unknown`: it could not repeat the job."""


class Source(NamedTuple):
    """Where an answer comes from: workers of one host that round alike."""

    host: str
    fingerprint: str
    """How they round, or how that begins."""


@dataclass(frozen=True, eq=False)
class Check:
    """An answer to be compared with the checker's."""

    source: Source
    header: RoundHeader
    """The job's round."""
    job: Jobs
    """One job, with its index in the round."""
    answer: bytes
    """As `RoundResults.answer` gives it."""
    owed: bool = False
    """Whether it is made because the host was due."""


@dataclass
class _Trust:
    passed: int = 0
    """Checks in which it was right."""
    rounds: int = 0
    """Rounds with answers of it since the last one that was made because it was due."""
    owed: int = 0
    """Checks that wait or are being made because it was due."""

    @property
    def due(self) -> bool:
        return not self.owed and self.rounds >= min(_GAP, 1 + self.passed // _STEP)


class Audit:
    """The checks of one round after another."""

    def __init__(self, share: float, rng: np.random.Generator) -> None:
        """Start without a round.

        Args:
          share: of the jobs to check, 0 to 1; 0: none.
          rng: decides which; it must be a secret of this process, and touches no number of the run.
        """
        self._share = share
        self._rng = rng
        self._best = -np.inf
        self._sources: list[Source] = []
        self._numbers: dict[Source, int] = {}  # their places in this list
        self._trust: dict[str, _Trust] = {}  # by host
        self._by = np.empty(0, dtype=int)
        self._first: list[Check] = []  # new bests, and answers that differed from others
        self._owed: list[Check] = []
        self._drawn: list[Check] = []
        self._earlier: list[Check] = []  # those that the round before has drawn
        self._out: list[Check] = []  # the checker has them

    def begin(self, header: RoundHeader, results: RoundResults) -> None:
        """Start a round with these empty results."""
        self._header = header
        self._round = results
        # For each job the place in self._sources of the answer's source; -1: it is not checked
        self._by = np.full(len(results), -1)
        self._earlier = self._drawn
        self._drawn = []
        self._rng.shuffle(self._earlier)  # type: ignore[arg-type]  # it takes any list

    def counted(self, source: Source, indices: np.ndarray) -> None:
        """Note that answers to these jobs were stored which are to be believed only if checked."""
        if source not in self._numbers:
            self._numbers[source] = len(self._sources)
            self._sources.append(source)
        trust = self._trust.setdefault(source.host, _Trust())
        self._by[indices] = self._numbers[source]
        chance = self._share * (1.0 if trust.passed >= _EARNED else _NEW)
        sample = indices[self._rng.random(len(indices)) < chance]
        self._drawn += [self._check(index) for index in sample.tolist()]

    def differed(self, source: Source | None, index: int, answer: bytes) -> None:
        """Check the stored answer to a job and another one that differs from it.

        Not if they come from machines that round differently. The other one is not checked if
        its source is None.
        """
        stored = None if self._by[index] < 0 else self._sources[self._by[index]]
        if not self._share or (stored and source and stored.fingerprint != source.fingerprint):
            return
        if stored is not None:
            self._first.append(self._check(index))
        if source is not None:
            self._trust.setdefault(source.host, _Trust())
            job = _copied(self._round.jobs, index)
            self._first.append(Check(source, self._header, job, answer))

    def ended(self) -> None:
        """All jobs of the round are done: choose its best, and answers of hosts that are due."""
        if not self._share:
            return
        best, value = self._round.best()
        if value > self._best:
            self._best = value
            if self._by[best] >= 0:
                self._first.append(self._check(best))
        returns = self._round.job_returns()
        for host in self.hosts:
            trust = self._trust[host]
            trust.rounds += 1
            if not trust.due:
                continue
            jobs = self._jobs_of(host)
            top = int(jobs[returns[jobs].argmax()])
            others = jobs[jobs != top]
            two = [int(self._rng.choice(others)), top] if len(others) else [top]
            self._owed += [replace(self._check(index), owed=True) for index in two]
            trust.owed = len(two)

    def take(self, most: int) -> list[Check]:
        """The next checks to make, at most so many, all of one round."""
        waiting = [each for queue in self._queues for each in queue]
        batch = [each for each in waiting if each.header is waiting[0].header][:most]
        ids = {id(each) for each in batch}
        for queue in self._queues:
            queue[:] = [each for each in queue if id(each) not in ids]
        self._out += batch
        return batch

    def found(self, check: Check, finding: Finding) -> str:
        """Take in what the checker says of an answer; the host that must be expelled, if any."""
        if check not in self._out:
            return ""  # of a host that was expelled meanwhile
        self._out.remove(check)
        trust = self._trust[check.source.host]
        trust.owed -= check.owed
        if finding == "right":
            trust.passed += 1
            trust.rounds = 0 if check.owed else trust.rounds
        return check.source.host if finding == "wrong" else ""

    @property
    def settled(self) -> bool:
        """Whether no check waits or is being made."""
        return not self._out and not any(self._queues)

    @property
    def hosts(self) -> list[str]:
        """The hosts whose answers this round has and that are not believed without checks."""
        numbers = sorted({*self._by.tolist()} - {-1})
        return list(dict.fromkeys(self._sources[each].host for each in numbers))

    @property
    def passed(self) -> dict[str, int]:
        """Number of checks that each host has passed, by name; of those only that have answered."""
        return {name: trust.passed for name, trust in sorted(self._trust.items())}

    def expel(self, host: str) -> list[int]:
        """Discard a host's answers; return its jobs of this round, which must be repeated."""
        jobs = self._jobs_of(host)
        self._by[jobs] = -1
        self._trust.pop(host, None)
        self._best = -np.inf  # it may have been a lie
        for queue in (*self._queues, self._out):
            queue[:] = [each for each in queue if each.source.host != host]
        expelled: list[int] = jobs.tolist()
        return expelled

    @property
    def _queues(self) -> tuple[list[Check], ...]:
        return self._first, self._owed, self._earlier, self._drawn

    def _check(self, index: int) -> Check:
        """A check of the stored answer to a job of this round."""
        source = self._sources[self._by[index]]
        return Check(
            source, self._header, _copied(self._round.jobs, index), self._round.answer(index)
        )

    def _jobs_of(self, host: str) -> np.ndarray:
        mask = np.array([*(source.host == host for source in self._sources), False])  # -1: nobody's
        return np.flatnonzero(mask[self._by])


def _copied(jobs: Jobs, index: int) -> Jobs:
    """One job of a round, which does not keep the others' arrays."""
    job = jobs.take([index])
    return Jobs(table=job.table.copy(), eps=job.eps.copy())
