"""What a worker keeps of its runs' messages: in turn, of the present round, and no more than it has
room for.
"""

import numpy as np
import pytest

from farm.errors import MessageError
from farm.net.work import Chunk, Jobs, RoundHeader
from workers import inbox
from workers.inbox import Inbox


def header(run: str, number: int = 1, size: int = 2) -> RoundHeader:
    return RoundHeader(
        run=run,
        incarnation="i",
        round=number,
        generation=0,
        spec="s",
        traces="none",
        mu=np.zeros(size),
    )


def chunk(run: str, jobs: int = 1, number: int = 1) -> Chunk:
    return Chunk.carrying(
        Jobs.exploring(np.zeros((jobs, 2)), (1,), None), run=run, incarnation="i", round=number
    )


def test_runs_take_turns() -> None:
    box = Inbox(10)
    for run in ("a", "b"):
        box.begin(header(run))
        for _ in range(2):
            box.put(chunk(run))
    assert box.working
    order = []
    while waiting := box.next():
        assert waiting[0].run == waiting[1].run
        order.append(waiting[1].run)
    assert order == ["a", "b", "a", "b"]
    assert not box.working


def test_a_new_round_drops_the_work_of_the_old_one() -> None:
    box = Inbox(10)
    box.begin(header("a", 2))
    box.put(chunk("a", number=2))
    box.begin(header("a", 1))
    assert box.of("a").holds_round_of(chunk("a", number=2)), "a published header that is late"
    box.begin(header("a", 3))
    assert box.next() is None
    box.begin(header("a", 1), asked=True)
    assert box.of("a").holds_round_of(chunk("a", number=1)), "the learner itself says so"


def test_idle_runs_are_told_of_again_after_the_same_time() -> None:
    box = Inbox(10)
    box.begin(header("a"))
    box.begin(header("b"))
    box.put(chunk("b"))
    start = box.of("a").busy
    assert box.idle(start + 0.5, 1.0) == ()
    assert box.idle(start + 1.5, 1.0) == ("a",)
    assert box.idle(start + 2.0, 1.0) == ()
    assert box.idle(start + 2.5, 1.0) == ("a",)


def test_no_more_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbox, "_MEMORY", 1000)
    box = Inbox(3)
    box.begin(header("a", size=50))
    box.begin(header("b", size=90))
    assert box.of("a").header is None, "it will be asked for again"
    assert box.of("b").header is not None
    with pytest.raises(MessageError, match="run c wants more than"):
        box.begin(header("c", size=200))
    with pytest.raises(MessageError, match="sends 13 jobs, 3 were asked for"):
        box.put(chunk("b", jobs=13))


def test_a_run_that_left_and_names_that_are_none() -> None:
    box = Inbox(1)
    box.begin(header("a"))
    entry = box.left("a")
    assert entry is not None
    assert (entry.run, box.left("a"), box.runs) == ("a", None, ())
    with pytest.raises(MessageError, match="is not a name"):
        box.of("*")
