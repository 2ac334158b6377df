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


def test_a_chunk_that_overtakes_its_header_waits_for_it() -> None:
    box = Inbox(10)
    assert not box.keep_early(chunk("a"), 0.0), "the first header has to be asked for"
    box.begin(header("a"))
    assert not box.keep_early(chunk("a", number=1), 0.0), "it is no early one"
    assert box.keep_early(chunk("a", number=2), 0.0)
    assert box.keep_early(chunk("a", number=3), 0.0)
    assert box.expecting
    assert not box.working
    box.begin(header("a", 2))
    waiting = box.next()
    assert waiting is not None
    assert (waiting[0].round, waiting[1].round) == (2, 2)
    assert box.expecting, "the chunk of the round after it"
    box.begin(header("a", 4))
    assert not box.expecting
    assert box.next() is None


def test_a_header_that_does_not_come_in_time_is_asked_for() -> None:
    box = Inbox(10)
    box.begin(header("a"))
    assert box.keep_early(chunk("a", number=2), 0.0)
    assert box.keep_early(chunk("a", number=2), 0.06)
    assert box.overdue(0.05) == []
    assert len(box.overdue(0.11)) == 1
    assert len(box.overdue(0.2)) == 1
    assert not box.expecting


def test_few_chunks_wait_for_their_headers() -> None:
    box = Inbox(10)
    box.begin(header("a"))
    kept = [box.keep_early(chunk("a", number=2), 0.0) for _ in range(6)]
    assert kept == [True] * 4 + [False] * 2
    assert len(box.overdue(1.0)) == 4


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
