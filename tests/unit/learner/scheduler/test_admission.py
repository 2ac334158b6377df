"""Who may take part, and what is known of those who do."""

import pytest

from farm.net.messages import WorkRequest
from learner.scheduler.admission import Admission
from learner.scheduler.census import Census


def want(worker: str = "a/1", assets: str = "hand", canary: str = "bits") -> WorkRequest:
    return WorkRequest(
        worker=worker, credits=4, idle=(), version="7.7", assets=assets, canary=canary, host="h", cores=2
    )


def test_the_first_worker_decides_whose_numbers_count() -> None:
    admission = Admission("hand", None)
    assert admission.refusal(want()) is None
    assert admission.canary == "bits"
    assert admission.refusal(want("b/1")) is None
    assert "rounds differently" in str(admission.refusal(want("c/1", canary="others")))
    assert admission.canary == "bits"


def test_who_did_nothing_and_left_decides_nothing() -> None:
    admission = Admission("hand", None)
    admission.refusal(want(canary="odd"))
    admission.deserted()
    assert admission.refusal(want()) is None
    admission.counted()
    admission.deserted()
    assert admission.canary == "bits"


def test_a_resumed_run_knows_whose_numbers_count() -> None:
    admission = Admission("hand", "bits")
    assert "--mixed" in str(admission.refusal(want(canary="others")))
    assert admission.refusal(want()) is None


def test_other_assets_are_refused_and_decide_nothing() -> None:
    admission = Admission("hand", None, mixed=True)
    assert "its hand or objects are others (release 7.7)" in str(admission.refusal(want(assets="paw")))
    assert admission.canary is None


def test_mixed_machines_on_request() -> None:
    admission = Admission("hand", "bits", mixed=True)
    assert admission.refusal(want(canary="others")) is None
    assert admission.canary == "bits"


def test_rates_are_taken_over_the_last_ten_seconds() -> None:
    census = Census()
    census.asked(want(), 100.0)
    for second in range(101, 121):
        census.did("a/1", 30, float(second))
    (status,) = census.status(120.5)
    assert (status.worker, status.version, status.canary, status.rollouts) == ("a/1", "7.7", "bits", 600)
    assert status.rate == pytest.approx(30.0)
    assert status.seen == pytest.approx(0.5)
    (later,) = census.status(200.0)
    assert later.rate == 0.0


def test_a_new_worker_has_a_rate_at_once_and_one_that_left_has_none() -> None:
    census = Census()
    census.asked(want("b/1"), 0.0)
    census.did("b/1", 40, 2.0)
    census.did("stranger", 40, 2.0)
    assert [round(status.rate) for status in census.status(2.0)] == [20]
    census.left("b/1")
    census.left("b/1")
    assert census.status(3.0) == ()
