"""The tables of `farm evaluate` on a screen of 80 columns: no number is cut."""

from typing import Any

import pytest
from rich.console import Console

from learner.tools.evaluate.command import tables

MEASURES = ("height", "a measure with a name that is much longer than others", "error")


def row(at: int, success: float | None = 0.5) -> dict[str, Any]:
    """Figures that are all different, and wide."""
    value = 1000003.0 * (at + 1)
    return {
        "rollouts": 100000 + at,
        "failed": 200000 + at,
        "ended": 300000 + at,
        "success_rate": success,
        "return_mean": -value,
        "return_min": -2.0 * value,
        "return_max": 3.0 * value,
        "measures": {name: 1.23e-7 * (at + 1) for name in MEASURES},
    }


def numbers(figures: dict[str, Any]) -> set[str]:
    found = set()
    for each in figures.values():
        found |= {str(each[name]) for name in ("rollouts", "failed", "ended")}
        found |= {f"{each[name]:.3f}" for name in ("return_mean", "return_min", "return_max")}
        found |= {f"{value:.3g}" for value in each["measures"].values()}
    return found


@pytest.mark.parametrize("models", [0, 3, 9])
def test_no_number_is_cut(models: int) -> None:
    names = [f"model {i} {'with a long name ' * (i % 2)}" for i in range(models)]
    of = {name: row(2 + i) for i, name in enumerate(names)}
    figures: dict[str, Any] = {"run": "r", "nominal": row(0), "perturbed": row(1, None)}
    console = Console(width=80, record=True, file=None)
    shown = list(tables(figures | ({"models": of} if models else {}), 80))
    with console.capture() as capture:
        for table in shown:
            console.print(table)
    text = capture.get()
    assert all(len(line) <= 80 for line in text.splitlines())
    assert "…" not in text
    words = set(text.split())
    assert numbers({"nominal": row(0), "perturbed": row(1), **of}) <= words
    assert len(shown) == {0: 1, 3: 2, 9: 5}[models]
    assert text.count("rollouts") == len(shown)
    assert words >= {"50%", "-"}


def test_without_measures_and_returns() -> None:
    figures = {"nominal": row(0) | dict.fromkeys(("return_mean", "return_min", "return_max"))}
    figures["perturbed"] = figures["nominal"]
    [table] = tables(figures, 80)
    assert table.row_count == 7 + len(MEASURES)
