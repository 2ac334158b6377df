"""Hosts with wrong numbers are detected, and their jobs are repeated."""

from collections.abc import Callable

import numpy as np
import pytest
from doubles import PATIENT, WAIT, Hire, Learner, Worker, done, jobs

from farm.arrays import FloatArray
from farm.net import codec
from farm.net.messages import Refusal
from farm.net.work import Chunk, Results
from learner.scheduler.audit import Audit
from learner.scheduler.round import RoundResults, Shapes

ALL = PATIENT.__class__(straggler_seconds=60.0, audit=1.0)


class Host(Worker):
    """Answers on its own; `lie` turns a job's honest return into what it says."""

    answered, refused = 0, b""

    def serve(self, learner: Learner, lie=lambda value, _: value) -> None:
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
    result = learner.collect(jobs(count))
    while not result.done():
        for worker, lie in zip(hosts, lies, strict=True):
            worker.serve(learner, lie)
    return done(result.result(WAIT))


def honest(value: float, _: bool) -> float:
    return value


LIES = {
    "the last bit of all": lambda value, _: float(np.nextafter(value, np.inf)),
    "one percent of all": lambda value, _: 1.01 * value + 0.01,
    "its best only": lambda value, best: value + 1.0 if best else value,
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_a_host_that_lies_is_found_and_its_jobs_are_done_again(
    learner: Learner, hire: Hire, lie
) -> None:
    dispatcher = learner.show(ALL)
    hosts = [hire(name, Host) for name in ("a/1", "b/1", "liar/1")]
    for worker in hosts:
        worker.want(4)
    for _ in range(2):
        assert collected(learner, hosts, (honest, honest, lie)) == list(range(12))
    assert dispatcher.workers == ("a/1", "b/1")
    assert "host liar gave different numbers" in codec.decode(hosts[2].refused, Refusal).reason
    assert "unasked" not in dispatcher.notices.ignored, "an honest host is blamed"


def test_two_hosts_that_differ_wait_for_a_third(
    learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    dispatcher = learner.show(ALL)
    hosts = [hire("a/1", Host), hire("liar/1", Host)]
    for worker in hosts:
        worker.want(4)
    result = learner.collect(jobs(4))
    while "there is no third host" not in caplog.text:
        hosts[0].serve(learner)
        hosts[1].serve(learner, LIES["one percent of all"])
    assert not result.done()
    hosts.append(hire("b/1", Host))
    hosts[2].want(4)
    while not result.done():
        for worker in hosts:
            worker.serve(learner, LIES["one percent of all"] if worker is hosts[1] else honest)
    assert done(result.result(WAIT)) == list(range(4))
    assert dispatcher.workers == ("a/1", "b/1")


def test_a_check_without_a_second_host_delays_nothing(learner: Learner, hire: Hire) -> None:
    learner.show(PATIENT.__class__(straggler_seconds=0.2, audit=1.0))
    worker, deaf = hire("a/1", Host), hire("deaf/1", Host)
    worker.want(9)
    deaf.want(1)
    result = learner.collect(jobs(6))
    while not result.done():
        worker.serve(learner)
    assert done(result.result(WAIT)) == list(range(6))


def test_checks_are_handed_out_before_the_round_ends(learner: Learner, hire: Hire) -> None:
    dispatcher = learner.show(ALL)
    result = learner.collect(jobs(8))
    dispatcher._ledger.audit._late = False  # as in three of four rounds
    slow, quick = hire("slow/1", Host), hire("quick/1", Host)
    slow.want(1)
    share = slow.chunk()
    quick.want(4)
    others = quick.work(7)
    check = slow.chunk()
    assert len(share) == 1
    assert set(check.indices.tolist()) <= set(others), (
        "jobs of the other host, while its own is not done"
    )
    for chunk in (share, check):
        slow.answer(slow.results(chunk))
    while not result.done():
        slow.serve(learner)
        quick.serve(learner)
    assert done(result.result(WAIT)) == list(range(8))


@pytest.mark.parametrize("names", [("a/1", "a/2"), ("a/1",)])
def test_one_host_alone_is_not_checked(learner: Learner, hire: Hire, names) -> None:
    learner.show(ALL)
    hosts = [hire(name, Host) for name in names]
    for worker in hosts:
        worker.want(4)
    assert collected(learner, hosts, [honest] * len(hosts)) == list(range(12))
    assert sum(worker.answered for worker in hosts) == 12


# ---------------------------------------------------------------- what is checked


def filled(returns: FloatArray) -> RoundResults:
    results = RoundResults(jobs(len(returns)), "none", Shapes(trace=(0, 0), frame={}))
    results.returns[:] = np.repeat(returns, 2)
    return results


def checked(audit: Audit, returns: FloatArray, hosts: str = "ab") -> set[int]:
    """Play a round of these hosts in turn; return the repeated jobs, all of them answered."""
    audit.begin(len(returns))
    for index in range(len(returns)):
        audit.counted(f"{hosts[index % len(hosts)]}/1", np.array([index]))
    results, checks, workers = filled(returns), set(), [f"{host}/1" for host in hosts]
    while not audit.passed(results, workers):
        for worker, indices in audit.assign(workers, 0.0, 1.0).items():
            for index in indices:
                assert hosts[index % len(hosts)] != worker[0]
                checks.add(index)
                assert audit.answered(worker, index, results.answer(index), results.answer(index))
        assert not audit.settle()
    return checks


def secret(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def trusted(part: float, hosts: str = "ab") -> Audit:
    """Hosts that have passed many checks."""
    audit = Audit(part, secret())
    checked(audit, np.full(len(hosts), -9.0), hosts)
    for host in hosts:
        for _ in range(240):
            audit.credit(host)
    return audit


def test_the_part_that_is_checked_is_the_part_that_was_asked_for() -> None:
    rng, audit = np.random.default_rng(0), trusted(0.02)
    count = sum(len(checked(audit, rng.uniform(-10.0, -9.0, 100))) for _ in range(400))
    assert 0.02 * 40_000 * 0.9 <= count <= 0.02 * 40_000 * 1.1 + 80, (
        "and the best, as often as there is a new one"
    )


def test_a_new_best_is_always_checked_before_it_counts() -> None:
    audit = trusted(1e-9)
    for best in (-3.0, -2.0, -1.0):
        returns = np.full(20, -5.0)
        returns[7] = best
        assert checked(audit, returns) == {7}
    assert checked(audit, np.full(20, -5.0)) == set()


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
    rng, answers = np.random.default_rng(audit._rng.integers(2**32)), 0
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


def test_a_liar_in_all_but_its_best_is_found_within_two_rounds_of_thirty() -> None:
    for i in range(200):
        assert (
            answers_until_found(
                Audit(0.02, secret(i)), lambda _, returns: returns < returns.max(), 30, 30
            )
            is not None
        )


def test_what_is_checked_cannot_be_told_from_the_round() -> None:
    def play(seed: int) -> list[set[int]]:
        audit = Audit(0.02, secret(seed))
        return [checked(audit, np.full(30, -9.0)) for _ in range(20)]

    assert play(1) == play(1)
    assert play(1) != play(2)
    kinds = []
    audit = Audit(0.02, secret())
    for _ in range(400):
        audit.begin(4)
        kinds.append(audit._late)
    assert 70 <= sum(kinds) <= 130, "one in four"
    assert len({tuple(kinds[at : at + 8]) for at in range(0, 400, 8)}) > 30, "in no order"


def test_early_and_late_jobs_are_checked_alike() -> None:
    audit, half, counts = trusted(0.1), 10, np.zeros(20)
    for _ in range(2000):
        audit.begin(2 * half)
        checks = set()
        for part in (range(half), range(half, 2 * half)):
            for index in part:
                audit.counted("ab"[index % 2] + "/1", np.array([index]))
            results = filled(np.full(2 * half, -9.0))
            audit.choose(results, ("a/1", "b/1"), end=part.stop > half)
            for worker, indices in audit.assign(("a/1", "b/1"), 0.0, 1.0).items():
                for index in indices:
                    checks.add(index)
                    audit.answered(worker, index, results.answer(index), results.answer(index))
            assert not audit.settle()
        assert audit.passed(results, ("a/1", "b/1"))
        counts[list(checks)] += 1
    early, late = counts[:half].mean() / 2000, counts[half:].mean() / 2000
    assert early == pytest.approx(0.1, rel=0.1)
    assert late == pytest.approx(0.1, rel=0.1)


def test_no_round_chooses_before_as_many_hosts_have_answered_as_before() -> None:
    audit = Audit(0.5, secret())
    for number in range(1, 4):
        audit.begin(4)
        audit.counted("a/1", np.array([0, 1]))
        assert audit.early == (number == 1), "the first round does not know how many there are"
        audit.counted("b/1", np.array([2, 3]))
        assert audit.early


def test_a_host_that_nobody_could_check_is_owed_one() -> None:
    audit = Audit(0.02, secret())
    assert checked(audit, np.zeros(4), "a") == set()
    (owed,) = audit.owed().items()
    assert owed[0] == "a"
    assert 0 <= owed[1] < 4
    assert audit.passed_checks == {"a": 0}
    audit.credit("a")
    assert audit.owed() == {}
    assert audit.passed_checks == {"a": 1}
    checked(audit, np.zeros(4), "ab")
    assert audit.owed() == {}


def disputed(
    audit: Audit, *answers: bytes, judge: Callable[[int, str], bytes | None] | None = None
) -> dict[str, int]:
    """The liars when hosts a, b, ... give these answers to job 0, which a did first."""
    audit.begin(1)
    audit.counted("a/1", np.array([0]))
    for name, answer in zip("bcde", answers[1:], strict=False):
        audit.answered(f"{name}/1", 0, answers[0], answer)
    return audit.settle(judge)


def test_two_against_one_decide_and_nobody_else_does() -> None:
    right, wrong = b"right", b"wrong"
    assert disputed(Audit(1.0, np.random.default_rng(0)), right, wrong, right) == {"b": 0}
    assert disputed(Audit(1.0, np.random.default_rng(0)), wrong, right, right, right) == {"a": 0}
    for answers in (
        (right, wrong),
        (right, wrong, b"third"),
        (right, wrong, right, wrong),
        (right, wrong, b"x", right),
    ):
        audit = Audit(1.0, np.random.default_rng(0))
        assert disputed(audit, *answers) == {}
        assert audit.disputed.startswith("a and b")
    audit = Audit(1.0, np.random.default_rng(0))
    disputed(audit, right, wrong, b"third")
    assert audit.assign(("d/1", "e/1"), 0.0, 1.0) == {}, "a fourth answer cannot decide"
    assert not audit.due(9.0, 1.0)


def test_a_judge_decides_alone_and_against_any_number() -> None:
    questions = []

    def judge(index: int, canary: str) -> bytes:
        questions.append((index, canary))
        return b"right"

    assert disputed(Audit(1.0, np.random.default_rng(0)), b"right", b"wrong", judge=judge) == {
        "b": 0
    }
    assert disputed(
        Audit(1.0, np.random.default_rng(0)), b"wrong", b"right", b"wrong", b"wrong", judge=judge
    ) == {
        "a": 0,
        "c": 0,
        "d": 0,
    }
    assert disputed(Audit(1.0, np.random.default_rng(0)), b"wrong", b"worse", judge=judge) == {
        "a": 0,
        "b": 0,
    }
    assert questions == [(0, "one")] * 3
    assert disputed(Audit(1.0, np.random.default_rng(0)), b"right", b"right", judge=judge) == {}
    assert len(questions) == 3, "only a dispute is worth its time"


def test_a_judge_that_cannot_simulate_is_asked_once() -> None:
    questions, audit = [], Audit(1.0, np.random.default_rng(0))
    judge = lambda index, _: questions.append(index)  # noqa: E731
    assert disputed(audit, b"right", b"wrong", judge=judge) == {}
    assert audit.settle(judge) == {}
    assert questions == [0]


def test_none_are_checked_on_request() -> None:
    assert checked(Audit(0.0, np.random.default_rng(0)), np.arange(20.0)) == set()


KINDS = {"a/1": "x", "b/1": "x", "c/1": "y", "rig/1": ""}


def test_only_machines_whose_numbers_are_of_one_kind_are_compared() -> None:
    audit, results = Audit(1.0, np.random.default_rng(0), KINDS.__getitem__), filled(np.arange(8.0))
    audit.begin(8)
    for index in range(8):
        audit.counted(list(KINDS)[index % 4], np.array([index]))
    assert not audit.passed(results, list(KINDS))
    checks = audit.assign(list(KINDS), 0.0, 1.0)
    assert {worker: sorted(indices) for worker, indices in checks.items()} == {
        "b/1": [0, 4],
        "a/1": [1, 5],
    }
    for worker, indices in checks.items():
        for index in indices:
            assert audit.answered(worker, index, results.answer(index), results.answer(index))
    assert audit.settle() == {}
    assert audit.passed(results, list(KINDS)), "no host is like c, and a device is like no host"


def test_numbers_of_another_kind_do_not_expel() -> None:
    audit, results = Audit(1.0, np.random.default_rng(0), KINDS.__getitem__), filled(np.arange(2.0))
    audit.begin(2)
    audit.counted("a/1", np.array([0]))
    audit.counted("rig/1", np.array([1]))
    for worker in ("c/1", "rig/1"):
        assert not audit.answered(worker, 0, results.answer(0), b"others")
    for worker in ("a/1", "rig/1"):
        assert not audit.answered(worker, 1, results.answer(1), b"others")
    assert audit.settle() == {}
    assert not audit.disputed
    assert audit.expel("rig") == []
