"""Which workers may join, which announced workers are connected, and what the learner knows about each."""

import pytest

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from learner.scheduler import membership
from learner.scheduler.membership import Admission, Attendance, Census


def want(worker: str = "a/1", credits: int = 4, canary: str = "bits") -> WorkRequest:
    return WorkRequest(worker=worker, credits=credits, idle=(), version="7.7", canary=canary, host="h", cores=2)


# ---------------------------------------------------------------- admission


def test_a_device_is_admitted_among_mixed_machines_and_decides_nothing() -> None:
    assert "it is a device" in str(Admission(None).refusal(want(canary="")))
    admission = Admission(None, mixed=True)
    assert admission.refusal(want(canary="")) is None
    assert not admission.counted("")
    assert admission.counted("bits")
    assert admission.refusal(want(canary="")) is None


def test_the_first_result_decides_whose_numbers_count() -> None:
    admission = Admission(None)
    assert admission.refusal(want(canary="odd")) is None
    assert admission.refusal(want("b/1")) is None
    assert admission.counted("bits")
    assert not admission.counted("bits")
    assert admission.refusal(want("b/1")) is None
    assert "rounds differently" in str(admission.refusal(want("c/1", canary="others")))
    assert admission.canary == "bits"


def test_a_resumed_run_knows_whose_numbers_count() -> None:
    admission = Admission("bits")
    assert "--mixed" in str(admission.refusal(want(canary="others")))
    assert admission.refusal(want()) is None


def test_mixed_machines_on_request() -> None:
    admission = Admission("bits", mixed=True)
    assert admission.refusal(want(canary="others")) is None
    assert admission.canary == "bits"


# ---------------------------------------------------------------- attendance


def test_a_worker_is_present_while_its_token_is() -> None:
    known = Attendance()
    assert known.came("a/1") is None
    assert known.asked(want("a/1"), 0.0)
    known.left("a/1")
    assert not known.asked(want("a/1"), 0.0)


def test_a_question_ahead_of_its_token_is_heard_once_it_comes() -> None:
    known = Attendance()
    assert not known.asked(want("a/1", 4), 0.0)
    assert not known.asked(want("a/1", 5), 1.0)
    assert known.came("a/1") == want("a/1", 5)
    assert known.came("a/1") is None
    assert known.absent(100.0) == []


def test_a_worker_that_never_comes_is_forgotten() -> None:
    known = Attendance()
    known.asked(want("a/1"), 0.0)
    known.asked(want("b/1"), 2.0)
    known.asked(want("a/1"), 2.9)
    assert known.absent(3.0) == []
    assert known.absent(4.0) == ["a/1"]
    assert known.came("a/1") is None
    assert known.came("b/1") == want("b/1")


def test_early_requests_are_checked_in_turn() -> None:
    known = Attendance()
    for name in ("a/1", "b/1", "c/1"):
        known.asked(want(name), 0.0)
    assert [known.early(2) for _ in range(3)] == [["a/1", "b/1"], ["c/1", "a/1"], ["b/1", "c/1"]]


def test_many_tokens_of_one_name_do_not_exclude_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership, "_MOST_OF_ONE", 2)
    known = Attendance()
    for i in range(2):
        known.came(f"many/{i}")
    with pytest.raises(MessageError, match="of its name"):
        known.came("many/2")
    assert known.came("honest/1") is None
    known.left("many/0")
    known.came("many/2")


def test_names_and_tokens_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership, "_MOST", 2)
    monkeypatch.setattr(membership, "_ASKING", 2)
    known = Attendance()
    for name in ("a/1", "b/1"):
        known.came(name)
    with pytest.raises(MessageError, match="there are already 2 workers, or 1000 of its name"):
        known.came("c/1")
    known.came("b/1")
    for name in ("d/1", "e/1"):
        known.asked(want(name), 0.0)
    with pytest.raises(MessageError, match="2 requests of workers"):
        known.asked(want("f/1"), 0.0)
    assert not known.asked(want("d/1", 9), 0.0)
    known.left("a/1")
    assert known.came("c/1") is None


# ---------------------------------------------------------------- census


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
