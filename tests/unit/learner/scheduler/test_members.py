"""Who takes part in a run, with which rate, and why others do not."""

import pytest
from doubles import request

from learner.scheduler.membership import Admission, Members


def test_rates_are_taken_over_the_last_ten_seconds() -> None:
    members = Members(Admission("c"))
    members.asked(request("a/1"), 100.0)
    for second in range(101, 121):
        members.did("a/1", 30, float(second))
    (status,) = members.status(120.5)
    assert (status.worker, status.version, status.canary, status.rollouts) == ("a/1", "0", "c", 600)
    assert status.rate == pytest.approx(30.0)
    assert status.seen == pytest.approx(0.5)
    (later,) = members.status(200.0)
    assert later.rate == 0.0


def test_a_new_worker_has_a_rate_at_once_and_one_that_left_has_none() -> None:
    members = Members(Admission("c"))
    members.asked(request("b/1"), 0.0)
    members.did("b/1", 40, 2.0)
    members.did("stranger", 40, 2.0)
    assert [round(status.rate) for status in members.status(2.0)] == [20]
    members.left("b/1")
    members.left("b/1")
    assert members.status(3.0) == ()


def test_a_worker_that_cannot_serve_the_run_may_come_back_as_another() -> None:
    members = Members(Admission("c"))
    members.asked(request("a/1"), 0.0)
    members.decline("a/1", "no mesh")
    assert (members.status(1.0), members.reasons) == ((), ["no mesh"])
    members.left("a/1")
    assert members.reasons == []


def test_no_worker_of_an_expelled_host_takes_part() -> None:
    members = Members(Admission("c"))
    for worker in ("a/1", "a/2", "b/1"):
        members.asked(request(worker), 0.0)
    assert members.expel("a", "it lies") == ["a/1", "a/2"]
    assert members.refusal(request("a/3")) == "it lies"
    assert members.refusal(request("b/1")) is None
