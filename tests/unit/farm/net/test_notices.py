"""What is ignored is counted each time, and logged once."""

import logging

import pytest

from farm.net.notices import Notices

LOG = logging.getLogger("farm.made_up")


def test_a_text_is_logged_once_and_counted_each_time(caplog: pytest.LogCaptureFixture) -> None:
    notices = Notices(LOG)
    for _ in range(3):
        notices.ignore("bad", "of a/1:\x1b no\nnumbers")
    notices.ignore("large", "of a/1")
    assert notices.ignored == {"bad": 3, "large": 1}
    assert caplog.messages == ["ignored a message of a/1:? no numbers", "ignored a message of a/1"]


def test_late_answers_are_counted_and_nothing_is_said(caplog: pytest.LogCaptureFixture) -> None:
    notices = Notices(LOG)
    for kind in ("stale", "doubled", "unasked"):
        notices.ignore(kind, f"of a/1: {kind}")
    assert notices.ignored == {"stale": 1, "doubled": 1, "unasked": 1}
    assert caplog.messages == ["ignored a message of a/1: unasked"]


def test_of_equal_tracebacks_only_the_first_is_shown(caplog: pytest.LogCaptureFixture) -> None:
    notices = Notices(LOG)
    for worker in ("a/1", "b/1", "a/1"):
        notices.once(f"worker {worker} failed", ("line 3", "ValueError: no"))
    assert caplog.messages == [
        "worker a/1 failed",
        "  line 3",
        "  ValueError: no",
        "worker b/1 failed",
    ]


def test_a_hostile_sender_cannot_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    notices = Notices(LOG)
    for number in range(5000):
        notices.once(f"made up {number}", level=logging.ERROR)
    assert len(caplog.records) <= 1000
    assert {record.levelno for record in caplog.records} == {logging.ERROR}
