"""Received events: in order, in bounded memory, and with timeouts that are kept."""

import queue
import signal
import threading
import time
from types import FrameType

import pytest

from farm.net.events import Event, Events


def event(number: int) -> Event:
    return Event("inbox", f"k/{number}", b"x")


def test_first_come_first_served() -> None:
    events = Events()
    for number in range(5):
        events.put(event(number))
    assert events.get() == event(0)
    assert len(events) == 4
    assert events.waiting(1.0) == [event(number) for number in range(1, 5)]
    assert events.waiting(0.0) == []
    with pytest.raises(queue.Empty):
        events.get(timeout=0.001)


def test_a_sender_that_floods_leaves_room_for_the_others() -> None:
    events = Events()
    for _ in range(3):
        for _ in range(1000):
            events.put(event(1), most=10)
        events.put(event(2), most=10)
        assert events.waiting(0.0) == [event(1)] * 10 + [event(2)]
    assert events.dropped == 3 * 990
    events.put(event(1), most=10)
    assert len(events) == 1


def test_a_waiting_thread_is_woken() -> None:
    events = Events()
    threading.Timer(0.05, events.put, [event(1)]).start()
    assert events.waiting(20.0) == [event(1)]


def test_a_signal_near_the_end_does_not_make_it_wait_for_ever() -> None:
    """A handler that outlasts the time is what SimpleQueue.get does not survive."""
    events, delivery = Events(), threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        delivery.set()
        time.sleep(0.1)

    rescue = threading.Timer(10.0, events.put, [event(1)])
    rescue.start()
    before = signal.signal(signal.SIGALRM, handle)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        assert events.waiting(0.1) == []
    finally:
        signal.signal(signal.SIGALRM, before)
        rescue.cancel()
    assert delivery.is_set()
