"""Hosts with wrong numbers are found by checks, and their jobs are repeated."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from doubles import HEADER, PATIENT, WAIT, Hire, Learner, Worker, done, jobs, secret

from farm.arrays import FloatArray
from farm.net import codec
from farm.net.messages import Refusal
from farm.net.work import Chunk, Results
from learner.pool.audit import Audit, Check, Source
from learner.pool.round import RoundResults, Shapes

ALL = replace(PATIENT, audit=1.0)


class Host(Worker):
    """Answers on its own; `lie` turns a job's honest return into what it says."""

    answered = 0
    refused = b""

    def serve(self, lie: Callable[[float, bool], float] = lambda value, _: value) -> None:
        """Work until the round is over."""
        for event in self.session.events.waiting(0.02):
            if event.topic == "refused":
                self.refused = event.payload
            if event.topic != "inbox":
                continue
            chunk = codec.decode(event.payload, Chunk)
            honest = self.results(chunk)
            best = max(honest.returns)
            returns = np.array([lie(value, value == best) for value in honest.returns])
            self.answer(Results(**{**vars(honest), "returns": returns}))
            self.answered += len(chunk)


def collected(learner: Learner, hosts: list[Host], lies, count: int = 12) -> list[float]:
    """A round in which hosts[i] lies by lies[i]."""
    result = learner.collect(jobs(count), checked=True)
    while not result.done():
        for worker, lie in zip(hosts, lies, strict=True):
            worker.serve(lie)
    return done(result.result(WAIT))


def honest(value: float, _: bool) -> float:
    return value


LIES = {
    "the last bit of all": lambda value, _: float(np.nextafter(value, np.inf)),
    "one percent of all": lambda value, _: 1.01 * value + 0.01,
    "its best only": lambda value, best: value + 1.0 if best else value,
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
@pytest.mark.parametrize("audit", [1.0, 1e-9])
def test_a_host_that_lies_is_found_and_its_jobs_are_done_again(
    learner: Learner, hire: Hire, lie, audit: float
) -> None:
    pool = learner.show(replace(ALL, audit=audit), checked=True)
    hosts = [hire(name, Host) for name in ("a/1", "b/1", "liar/1")]
    for worker in hosts:
        worker.want(4)
    for _ in range(2):
        assert collected(learner, hosts, (honest, honest, lie)) == list(range(12))
    assert pool.workers == ("a/1", "b/1")
    assert "host liar gave other numbers" in codec.decode(hosts[2].refused, Refusal).reason
    assert "unasked" not in pool.notices.ignored, "an honest host is blamed"


def test_a_majority_of_liars_is_expelled(learner: Learner, hire: Hire) -> None:
    pool = learner.show(ALL, checked=True)
    hosts = [hire(name, Host) for name in ("a/1", "b/1", "c/1", "d/1")]
    for worker in hosts:
        worker.want(4)
    lie = LIES["one percent of all"]
    assert collected(learner, hosts, (lie, lie, honest, lie)) == list(range(12))
    assert pool.workers == ("c/1",)


def test_a_host_alone_is_checked(learner: Learner, hire: Hire) -> None:
    pool = learner.show(ALL, checked=True)
    liar = hire("liar/1", Host)
    liar.want(4)
    result = learner.collect(jobs(4), checked=True)
    while pool.workers or not liar.answered:
        liar.serve(LIES["the last bit of all"])
    good = hire("a/1", Host)
    good.want(4)
    while not result.done():
        good.serve()
    assert done(result.result(WAIT)) == list(range(4))
    assert pool.checks["a"] >= 4


def test_no_round_waits_for_a_check(learner: Learner, hire: Hire) -> None:
    pool = learner.show(ALL, checked=True)
    checker = pool._checker
    checker.room = 0  # type: ignore[union-attr]  # it is busy
    worker = hire("liar/1", Host)
    worker.want(4)
    for _ in range(2):
        result = learner.collect(jobs(4))
        while not result.done():
            worker.serve(lambda value, _: value + 1.0)
        assert done(result.result(WAIT)) == [1.0, 2.0, 3.0, 4.0]
    checker.room = 9  # type: ignore[union-attr]
    result = learner.collect(jobs(4))
    while pool.workers:
        worker.serve()
    assert "of generation 0" in pool.admission.expelled["liar"], "an answer of an earlier round"
    learner.stop.set()


# ---------------------------------------------------------------- what is checked


def filled(returns: FloatArray) -> RoundResults:
    results = RoundResults(jobs(len(returns)), "none", Shapes(trace=(0, 0), frame={}))
    results.returns[:] = np.repeat(returns, 2)
    return results


def played(audit: Audit, returns: FloatArray, hosts: str = "ab") -> None:
    """A round of these hosts in turn."""
    results = filled(returns)
    audit.begin(replace(HEADER), results)
    for index in range(len(returns)):
        host = hosts[index % len(hosts)]
        audit.counted(Source(host, "bits"), np.array([index]))
    audit.ended()


def made(audit: Audit, most: int = 10**6) -> list[Check]:
    """Checks that wait, all right."""
    checks: list[Check] = []
    while len(checks) < most and (batch := audit.take(min(64, most - len(checks)))):
        checks += batch
        for check in batch:
            assert audit.found(check, "right") == ""
    return checks


def checked(audit: Audit, returns: FloatArray, hosts: str = "ab") -> set[int]:
    """Jobs that are checked of a round of these hosts in turn."""
    played(audit, returns, hosts)
    return {number(each) for each in made(audit)}


def number(check: Check) -> int:
    return int(check.job.indices[0])


def trusted(part: float, hosts: str = "ab") -> Audit:
    """Hosts that have passed many checks."""
    audit = Audit(1.0, secret())
    while min(audit.passed.values(), default=0) < 240:
        checked(audit, np.full(100, -9.0), hosts)
    audit._share = part
    return audit


def test_the_part_that_is_checked_is_the_part_that_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    audit = trusted(0.02)
    count = sum(len(checked(audit, rng.uniform(-10.0, -9.0, 100))) for _ in range(400))
    due = 2 * 2 * 400 / 20  # of two hosts two jobs in twenty rounds
    assert 0.02 * 40_000 * 0.9 <= count <= 0.02 * 40_000 * 1.1 + due


def test_a_new_best_is_always_checked_and_before_all_others() -> None:
    audit = trusted(1e-9)
    checked(audit, np.full(20, -5.0))
    for best in (-3.0, -2.0, -1.0):
        returns = np.full(20, -5.0)
        returns[7] = best
        assert checked(audit, returns) == {7}
    audit._share = 1.0
    returns[8] = 1.0
    played(audit, returns)
    assert number(audit.take(1)[0]) == 8


def test_a_new_host_is_checked_in_each_round_and_a_trusted_one_every_twenty() -> None:
    new = Audit(1e-9, secret())
    for _ in range(3):
        assert {job % 3 for job in checked(new, np.full(6, -9.0), "abc")} == {0, 1, 2}
    audit = trusted(1e-9, "abc")
    rounds = [{job % 3 for job in checked(audit, np.full(6, -9.0), "abc")} for _ in range(60)]
    for first in range(41):
        assert set().union(*rounds[first : first + 20]) == {0, 1, 2}
    assert sum(map(len, rounds)) == 9, "and no more often than that"


def answers_until_found(
    audit: Audit, lies: Callable[[np.ndarray, np.ndarray], np.ndarray], jobs: int, most: int
) -> int | None:
    """The answers of host b until it is found; None if that takes more than so many.

    `lies` says which are lies.
    """
    rng = np.random.default_rng(audit._rng.integers(2**32))
    answers = 0
    while answers < most:
        returns = rng.uniform(-10.0, -9.0, jobs)
        false = lies(np.arange(answers, answers + jobs // 2), returns[1::2])
        answers += jobs // 2
        if false[[job // 2 for job in checked(audit, returns) if job % 2]].any():
            return answers
    return None


def test_a_liar_in_one_of_fifty_jobs_is_found_within_three_thousand_answers() -> None:
    times = [
        answers_until_found(Audit(0.02, secret(i)), lambda at, _: at % 50 == 7, 100, 3000)
        for i in range(100)
    ]
    assert sum(time is None for time in times) <= 2, "1 % of cases on average"


def test_a_liar_in_all_but_its_best_is_found_in_its_first_round() -> None:
    for i in range(200):
        audit = Audit(0.02, secret(i))
        assert answers_until_found(audit, lambda _, returns: returns < returns.max(), 30, 15)


def test_what_is_checked_cannot_be_told_from_the_round() -> None:
    def play(seed: int) -> list[set[int]]:
        audit = Audit(0.02, secret(seed))
        return [checked(audit, np.full(30, -9.0)) for _ in range(20)]

    assert play(1) == play(1)
    assert play(1) != play(2)


def test_early_and_late_jobs_are_checked_alike_also_by_a_checker_that_is_too_slow() -> None:
    audit = trusted(0.5)
    counts = np.zeros(20)
    for _ in range(1000):
        played(audit, np.full(20, -9.0))
        counts[[number(each) for each in made(audit, 5)]] += 1
    assert counts[:10].sum() == pytest.approx(counts[10:].sum(), rel=0.1)


def test_a_slow_checker_leaves_out_shares_but_no_host() -> None:
    audit = Audit(1.0, secret())
    hosts = "abcdefghij"
    for _ in range(40):
        played(audit, np.full(20, -9.0), hosts)
        made(audit, 1)
        assert sum(map(len, audit._queues)) <= 1 + 20 + 2 * 20, "a new best, the due, two rounds"
    assert min(audit.passed.values()) >= 1, "a host after the other"


def test_nothing_is_checked_on_request() -> None:
    assert checked(Audit(0.0, secret()), np.arange(20.0)) == set()


def test_answers_of_machines_that_round_differently_may_differ() -> None:
    audit = Audit(1e-9, secret())
    results = filled(np.zeros(2))
    audit.begin(HEADER, results)
    audit.counted(Source("a", "x"), np.array([0]))
    audit.differed(Source("b", "y"), 0, b"others")
    assert audit.settled
    audit.differed(Source("c", "x"), 0, b"others")
    assert [check.source.host for check in audit.take(9)] == ["a", "c"]


def test_what_is_found_of_an_expelled_host_is_ignored() -> None:
    audit = Audit(1.0, secret())
    played(audit, np.zeros(4))
    checks = audit.take(9)
    (wrong,) = {audit.found(each, "wrong") for each in checks if each.source.host == "b"}
    assert wrong == "b"
    assert audit.expel("b") == [1, 3]
    assert {audit.found(each, "wrong") for each in checks} == {"a", ""}
    assert audit.hosts == ["a"]
    assert "b" not in audit.passed
