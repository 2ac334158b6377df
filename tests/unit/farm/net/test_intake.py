"""Which machines send much that should send little."""

from farm.net.intake import FORGIVEN, MOST, Intake


def test_a_machine_is_counted_over_all_its_connections_and_only_what_is_new() -> None:
    intake = Intake()
    machines = {"h:1": "looker", "h:2": "looker", "h:3": "other"}
    assert intake.over({"h:1": FORGIVEN, "h:2": 0, "h:3": FORGIVEN}, machines) == []
    received = {"h:1": FORGIVEN + MOST - 9, "h:2": 10, "h:3": FORGIVEN}
    assert intake.over(received, machines) == ["looker"]
    assert intake.over({**received, "h:3": FORGIVEN + MOST}, machines) == []


def test_a_connection_that_is_new_counts_from_nothing() -> None:
    intake = Intake()
    assert intake.over({"h:1": 9 * MOST}, {}) == []
    assert intake.over({"h:1": 9 * MOST, "h:2": MOST + 1}, {"h:2": "looker"}) == ["looker"]


def test_a_flood_that_is_slow_adds_up_and_a_recorder_does_not() -> None:
    intake = Intake()
    machines = {"h:1": "slow", "h:2": "recorder"}
    counts = (
        intake.over({"h:1": 3 * FORGIVEN * n, "h:2": FORGIVEN * n}, machines) for n in range(99)
    )
    assert next(number for number, over in enumerate(counts) if over) == 5
    assert ["recorder"] not in list(counts)


def test_a_machine_that_connects_again_and_again_is_counted_on() -> None:
    intake = Intake()
    counts = [
        over
        for n in range(9)
        for over in intake.over({f"h:{n}": 4 * FORGIVEN}, {f"h:{n}": "looker"})
    ]
    assert counts == ["looker", "looker"]
