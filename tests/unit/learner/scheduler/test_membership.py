"""Which workers may join, and which announced workers are connected."""

import pytest

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from learner.scheduler import membership
from learner.scheduler.membership import Admission, Attendance


def want(worker: str = "a/1", credits: int = 4, canary: str = "bits") -> WorkRequest:
    return WorkRequest(
        worker=worker, credits=credits, idle=(), version="7.7", canary=canary, host="h", cores=2
    )


# ---------------------------------------------------------------- admission


def test_a_device_is_admitted_among_mixed_machines() -> None:
    assert "it is a device" in str(Admission("bits").refusal(want(canary="")))
    assert Admission("bits", mixed=True).refusal(want(canary="")) is None


def test_only_machines_with_the_runs_numbers_are_admitted() -> None:
    for reference in ("bits", "bi"):
        admission = Admission(reference)
        assert admission.refusal(want()) is None
        reason = str(admission.refusal(want(canary="others")))
        assert f"(numbers others, the run's are {reference}:" in reason
        assert "--numbers others" in reason
        assert "--mixed" in reason


def test_mixed_machines_on_request() -> None:
    admission = Admission("bits", mixed=True)
    assert admission.refusal(want(canary="others")) is None
    assert admission.canary == "bits"


# ---------------------------------------------------------------- attendance


def test_a_worker_is_present_while_its_token_is() -> None:
    attendance = Attendance()
    assert attendance.came("a/1") is None
    assert attendance.asked(want("a/1"), 0.0)
    attendance.left("a/1")
    assert not attendance.asked(want("a/1"), 0.0)


def test_a_question_ahead_of_its_token_is_heard_once_it_comes() -> None:
    attendance = Attendance()
    assert not attendance.asked(want("a/1", 4), 0.0)
    assert not attendance.asked(want("a/1", 5), 1.0)
    assert attendance.came("a/1") == want("a/1", 5)
    assert attendance.came("a/1") is None
    assert attendance.absent(100.0) == []


def test_a_worker_that_never_comes_is_forgotten() -> None:
    attendance = Attendance()
    attendance.asked(want("a/1"), 0.0)
    attendance.asked(want("b/1"), 2.0)
    attendance.asked(want("a/1"), 2.9)
    assert attendance.absent(3.0) == []
    assert attendance.absent(4.0) == ["a/1"]
    assert attendance.came("a/1") is None
    assert attendance.came("b/1") == want("b/1")


def test_early_requests_are_checked_in_turn() -> None:
    attendance = Attendance()
    for name in ("a/1", "b/1", "c/1"):
        attendance.asked(want(name), 0.0)
    assert [attendance.early(2) for _ in range(3)] == [
        ["a/1", "b/1"],
        ["c/1", "a/1"],
        ["b/1", "c/1"],
    ]


def test_many_tokens_of_one_name_do_not_exclude_others(monkeypatch: pytest.MonkeyPatch) -> None:
    attendance = Attendance(2)
    for i in range(2):
        attendance.came(f"many/{i}")
    with pytest.raises(MessageError, match="of its name"):
        attendance.came("many/2")
    assert attendance.came("honest/1") is None
    attendance.left("many/0")
    attendance.came("many/2")


def test_names_and_tokens_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership, "_MOST", 2)
    monkeypatch.setattr(membership, "_ASKING", 2)
    attendance = Attendance()
    for name in ("a/1", "b/1"):
        attendance.came(name)
    with pytest.raises(MessageError, match="there are already 2 workers, or 500 of its name"):
        attendance.came("c/1")
    attendance.came("b/1")
    for name in ("d/1", "e/1"):
        attendance.asked(want(name), 0.0)
    with pytest.raises(MessageError, match="2 requests of workers"):
        attendance.asked(want("f/1"), 0.0)
    assert not attendance.asked(want("d/1", 9), 0.0)
    attendance.left("a/1")
    assert attendance.came("c/1") is None
