"""Which machines send much that should send little."""

from farm.net.intake import MOST, Intake


def test_a_machine_is_counted_over_all_its_connections_and_only_what_is_new() -> None:
    intake = Intake()
    machines = {"h:1": "looker", "h:2": "looker", "h:3": "other"}
    assert intake.over({"h:1": MOST, "h:2": 0, "h:3": MOST}, machines) == []
    assert intake.over({"h:1": 2 * MOST - 9, "h:2": 10, "h:3": MOST}, machines) == ["looker"]
    assert intake.over({"h:1": 2 * MOST - 9, "h:2": 10, "h:3": 2 * MOST}, machines) == []


def test_a_connection_that_is_new_counts_from_nothing() -> None:
    intake = Intake()
    assert intake.over({"h:1": 9 * MOST}, {}) == []
    assert intake.over({"h:1": 9 * MOST, "h:2": MOST + 1}, {"h:2": "looker"}) == ["looker"]
