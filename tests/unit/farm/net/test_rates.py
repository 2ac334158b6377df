"""Which machines send too much."""

from farm.net.rates import Rates

START = 10.0  # [s]; messages are counted over three seconds


def first(workers: int, each: int, seconds: float, rates: Rates) -> float | None:
    """When a machine whose workers send so many messages each, in turn, is found to flood [s]."""
    count = workers * each
    for at in range(count):
        if rates.flooding(f"many/{at % workers}", START + at * seconds / count):
            return at * seconds / count
    return None


def test_a_worker_that_sends_700_messages_floods_and_only_its_machine_is_named() -> None:
    rates = Rates()
    assert first(1, 650, 2.9, rates) is None
    assert first(1, 50, 0.0, rates) is not None
    assert not rates.flooding("few/0", START)


def test_workers_that_ask_once_per_second_do_not_flood() -> None:
    assert first(500, 60, 60.0, Rates()) is None


def test_more_workers_than_a_machine_may_have_flood() -> None:
    assert first(1000, 3, 2.9, Rates()) is not None
    rates = Rates()
    rates.most = 4000
    assert first(1000, 30, 30.0, rates) is None
