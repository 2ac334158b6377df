"""Hosts with wrong numbers are detected, and their jobs are repeated."""

import numpy as np
import pytest
from doubles import PATIENT, WAIT, Hire, Learner, Worker, done, jobs

from farm.arrays import FloatArray
from farm.net import codec
from farm.net.messages import Refusal
from farm.net.work import Chunk, Results
from learner.scheduler.audit import Audit
from learner.scheduler.round import RoundResults

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
def test_a_host_that_lies_is_found_and_its_jobs_are_done_again(learner: Learner, hire: Hire, lie) -> None:
    farm = learner.show(ALL)
    hosts = [hire(name, Host) for name in ("a/1", "b/1", "liar/1")]
    for worker in hosts:
        worker.want(4)
    for _ in range(2):
        assert collected(learner, hosts, (honest, honest, lie)) == list(range(12))
    assert farm.workers == ("a/1", "b/1")
    assert "host liar gave different numbers" in codec.decode(hosts[2].refused, Refusal).reason
    assert "unasked" not in farm.ignored, "an honest host is blamed"


def test_two_hosts_that_differ_wait_for_a_third(learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture) -> None:
    farm = learner.show(ALL)
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
    assert farm.workers == ("a/1", "b/1")


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
    learner.show(ALL)
    result = learner.collect(jobs(8))
    slow, quick = hire("slow/1", Host), hire("quick/1", Host)
    slow.want(1)
    own = slow.chunk()
    quick.want(4)
    others = quick.work(7)
    check = slow.chunk()
    assert len(own) == 1
    assert set(check.indices.tolist()) <= set(others), "jobs of the other host, while its own is not done"
    for chunk in (own, check):
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
    results = RoundResults(jobs(len(returns)), "none", (0, 0), {})
    results.returns[:] = np.repeat(returns, 2)
    return results


def checked(audit: Audit, returns: FloatArray, hosts: str = "ab") -> set[int]:
    """Play a round of these hosts in turn; return the repeated jobs, all of them answered."""
    audit.begin(len(returns))
    for index in range(len(returns)):
        audit.counted(f"{hosts[index % len(hosts)]}/1", np.array([index]))
    results, asked, workers = filled(returns), set(), [f"{host}/1" for host in hosts]
    while not audit.passed(results, workers):
        for worker, indices in audit.assign(workers, 0.0, 1.0).items():
            for index in indices:
                assert hosts[index % len(hosts)] != worker[0]
                asked.add(index)
                assert audit.answered(worker, index, results.answer(index), results.answer(index))
        assert not audit.settle()
    return asked


def test_the_part_that_is_checked_is_the_part_that_was_asked_for() -> None:
    rng, audit = np.random.default_rng(0), Audit(0.02)
    rounds = [checked(audit, rng.uniform(-1.0, 0.0, 30)) for _ in range(200)]
    count = sum(map(len, rounds))
    assert 0.02 * 6000 <= count <= 0.02 * 6000 + 10  # and the best of the run, as often as there is a new one


def test_a_new_best_is_always_checked_before_it_counts() -> None:
    audit = Audit(1e-9)
    for best in (-3.0, -2.0, -1.0):
        returns = np.full(20, -5.0)
        returns[7] = best
        assert checked(audit, returns) == {7}
    assert checked(audit, np.full(20, -5.0)) == set()


def test_hosts_are_checked_in_turn() -> None:
    audit = Audit(0.25)
    rounds = [checked(audit, np.zeros(4), "abc") for _ in range(7)]
    assert [{job % 3 for job in jobs} for jobs in rounds] == [{0}, {1}, {2}] * 2 + [{0}]


def test_three_of_four_rounds_choose_when_half_of_their_jobs_are_done() -> None:
    audit, half = Audit(0.5), 4
    early = []
    for _ in range(8):
        audit.begin(2 * half)
        for index in range(half):
            audit.counted("ab"[index % 2] + "/1", np.array([index]))
        early.append(audit.early)
        if audit.early:
            audit.choose(filled(np.arange(8.0)), ("a/1", "b/1"), end=False)
            asked = audit.assign(("a/1", "b/1"), 0.0, 1.0)
            assert sorted(job for jobs in asked.values() for job in jobs) == list(range(half))
            assert not audit.early
    assert early == [True, True, True, False] * 2


def test_no_round_chooses_before_as_many_hosts_have_answered_as_before() -> None:
    audit = Audit(0.5)
    for number in range(1, 4):
        audit.begin(4)
        audit.counted("a/1", np.array([0, 1]))
        assert audit.early == (number == 1), "the first round does not know how many there are"
        audit.counted("b/1", np.array([2, 3]))
        assert audit.early


def test_none_are_checked_on_request() -> None:
    assert checked(Audit(0.0), np.arange(20.0)) == set()


KINDS = {"a/1": "x", "b/1": "x", "c/1": "y", "rig/1": ""}


def test_only_machines_whose_numbers_are_of_one_kind_are_compared() -> None:
    audit, results = Audit(1.0, KINDS.__getitem__), filled(np.arange(8.0))
    audit.begin(8)
    for index in range(8):
        audit.counted(list(KINDS)[index % 4], np.array([index]))
    assert not audit.passed(results, list(KINDS))
    asked = audit.assign(list(KINDS), 0.0, 1.0)
    assert {worker: sorted(indices) for worker, indices in asked.items()} == {"b/1": [0, 4], "a/1": [1, 5]}
    for worker, indices in asked.items():
        for index in indices:
            assert audit.answered(worker, index, results.answer(index), results.answer(index))
    assert audit.settle() == {}
    assert audit.passed(results, list(KINDS)), "no host is like c, and a device is like no host"


def test_numbers_of_another_kind_do_not_expel() -> None:
    audit, results = Audit(1.0, KINDS.__getitem__), filled(np.arange(2.0))
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
