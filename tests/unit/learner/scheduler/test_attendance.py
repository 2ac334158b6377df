"""Who is there, among those who say so."""

import pytest

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from learner.scheduler import attendance
from learner.scheduler.attendance import Attendance


def want(worker: str, credits: int = 4) -> WorkRequest:
    return WorkRequest(worker=worker, credits=credits, idle=(), version="7", assets="a", canary="c", host="h", cores=2)


def test_who_has_a_token_is_there_until_it_goes() -> None:
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


def test_who_never_comes_is_forgotten() -> None:
    known = Attendance()
    known.asked(want("a/1"), 0.0)
    known.asked(want("b/1"), 2.0)
    known.asked(want("a/1"), 2.9)
    assert known.absent(3.0) == []
    assert known.absent(4.0) == ["a/1"]
    assert known.came("a/1") is None
    assert known.came("b/1") == want("b/1")


def test_names_and_tokens_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attendance, "_MOST", 2)
    monkeypatch.setattr(attendance, "_ASKING", 2)
    known = Attendance()
    for name in ("a/1", "b/1"):
        known.came(name)
    with pytest.raises(MessageError, match="2 workers are there already"):
        known.came("c/1")
    known.came("b/1")
    for name in ("d/1", "e/1"):
        known.asked(want(name), 0.0)
    with pytest.raises(MessageError, match="2 others ask"):
        known.asked(want("f/1"), 0.0)
    assert not known.asked(want("d/1", 9), 0.0)
    known.left("a/1")
    assert known.came("c/1") is None


def test_what_is_remembered_of_a_worker_is_short() -> None:
    with pytest.raises(ValueError, match="250 characters"):
        want("a/" + "1" * 250)
