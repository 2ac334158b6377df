"""What the learner's own machine decides: disputes of a round, and checks that no second host could
make.

Pure.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from farm.arrays import FloatArray
from farm.net.work import Jobs, RoundHeader, Simulated
from learner.scheduler.audit import Audit
from learner.scheduler.round import RoundResults, bits


class Judge(Protocol):
    """Answers to jobs that are certain."""

    def __call__(
        self, canary: str, mu: FloatArray, job: Jobs, normaliser: FloatArray, *, terms: bool
    ) -> Simulated | None:
        """Results of one job, as machines with this canary compute them, around a mean (P,).

        `normaliser` and `terms` are as in RoundHeader. None if it cannot say.
        """
        ...


class _Owed(NamedTuple):
    """A host's answer to one job, kept until the host has passed a check."""

    generation: int
    canary: str
    mu: FloatArray
    job: Jobs
    normaliser: FloatArray
    terms: bool
    answer: bytes


class Judging:
    """Asks a judge about jobs of one round after another."""

    def __init__(self, judge: Judge | None, canary: str | None) -> None:
        """Start without a round; `canary` is that of all workers, or None if they may differ."""
        self._judge, self._canary = judge, canary
        self.decided: set[int] = set()
        """Jobs of this round that the judge has decided."""
        self._owed: dict[str, _Owed] = {}  # by host

    def begin(self, header: RoundHeader, results: RoundResults) -> None:
        """A round starts."""
        self._mu, self._normaliser, self._terms = header.mu, header.normaliser, header.terms
        self._generation = header.generation
        self._round = results
        self.decided.clear()

    def right(self, index: int, canary: str) -> bytes | None:
        """The judge's answer to a job of this round, as machines with this canary compute it; None
        without one.
        """
        answer = self._asked(
            canary, self._mu, self._round.jobs.take([index]), self._normaliser, self._terms
        )
        if answer is not None:
            self.decided.add(index)
        return answer

    def ended(self, audit: Audit) -> None:
        """A round is over: keep an answer of each host whose check was due and not possible, one
        per host.
        """
        owed = audit.owed()
        self._owed = {name: debt for name, debt in self._owed.items() if audit.unchecked(name)}
        for name, index in owed.items():
            job = self._round.jobs.take([index])
            self._owed[name] = _Owed(
                self._generation,
                audit.canary_of(index),
                self._mu,
                Jobs(table=job.table.copy(), eps=job.eps.copy()),
                self._normaliser,
                self._terms,
                self._round.answer(index),
            )

    def settle(self, audit: Audit, warn: Callable[[str], None]) -> dict[str, int]:
        """Check the hosts that are owed a check; return those that were wrong, each with the
        generation.

        `warn` is told of hosts that nobody can check: they alone have their canary, or this machine
        cannot simulate.
        """
        wrong = {}
        for name, owed in self._owed.items():
            answer = self._asked(owed.canary, owed.mu, owed.job, owed.normaliser, owed.terms)
            if answer == owed.answer:
                audit.credit(name)
            elif answer is not None:
                wrong[name] = owed.generation
            else:
                kind = (
                    "the learner's machine does not round as it does, or cannot simulate the task"
                )
                warn(
                    f"the last answers of host {name} are unchecked: no other host could repeat"
                    f" them, and {kind}"
                )
        self._owed.clear()
        return wrong

    def _asked(
        self, canary: str, mu: FloatArray, job: Jobs, normaliser: FloatArray, terms: bool
    ) -> bytes | None:
        simulated = (
            self._judge(self._canary or canary, mu, job, normaliser, terms=terms)
            if self._judge
            else None
        )
        return None if simulated is None else bits(simulated, slice(None))
