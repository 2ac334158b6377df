"""Who takes part in a run, with which rate, and why others do not."""

import pytest
from doubles import request

from learner.scheduler.membership import Admission
from learner.scheduler.roster import Roster


def test_rates_are_taken_over_the_last_ten_seconds() -> None:
    roster = Roster(Admission("c"))
    roster.asked(request("a/1"), 100.0)
    for second in range(101, 121):
        roster.did("a/1", 30, float(second))
    (status,) = roster.status(120.5)
    assert (status.worker, status.version, status.canary, status.rollouts) == ("a/1", "0", "c", 600)
    assert status.rate == pytest.approx(30.0)
    assert status.seen == pytest.approx(0.5)
    (later,) = roster.status(200.0)
    assert later.rate == 0.0


def test_a_new_worker_has_a_rate_at_once_and_one_that_left_has_none() -> None:
    roster = Roster(Admission("c"))
    roster.asked(request("b/1"), 0.0)
    roster.did("b/1", 40, 2.0)
    roster.did("stranger", 40, 2.0)
    assert [round(status.rate) for status in roster.status(2.0)] == [20]
    roster.left("b/1")
    roster.left("b/1")
    assert roster.status(3.0) == ()


def test_a_worker_that_cannot_serve_the_run_may_come_back_as_another() -> None:
    roster = Roster(Admission("c"))
    roster.asked(request("a/1"), 0.0)
    roster.decline("a/1", "no mesh")
    assert (roster.status(1.0), roster.reasons) == ((), ["no mesh"])
    roster.left("a/1")
    assert roster.reasons == []


def test_no_worker_of_an_expelled_host_takes_part() -> None:
    roster = Roster(Admission("c"))
    for worker in ("a/1", "a/2", "b/1"):
        roster.asked(request(worker), 0.0)
    assert roster.expel("a", "it lies") == ["a/1", "a/2"]
    assert roster.refusal(request("a/3")) == "it lies"
    assert roster.refusal(request("b/1")) is None
