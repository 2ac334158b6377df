"""Which machines send too much."""

from farm.net.rates import Rates

MOST = Rates().most


def test_only_the_machine_that_sends_too_much_is_named() -> None:
    rates = Rates()
    assert not any(rates.flooding("many", 1.0) for _ in range(MOST))
    assert not rates.flooding("few", 1.0)
    assert rates.flooding("many", 1.0)
    assert not rates.flooding("few", 1.0)


def test_messages_are_counted_for_three_seconds() -> None:
    rates = Rates()
    assert not any(rates.flooding("slow", 0.01 * at) for at in range(10 * MOST // 7))
