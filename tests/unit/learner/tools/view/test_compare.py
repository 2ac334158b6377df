"""Comparison of runs: names, differences, results."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from made import stats
from rich.console import Console

from farm.errors import ConfigError
from farm.net.stats import GenerationStats
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.tools.view import compare
from learner.tools.view.compare import Compared, names, shown, table


def progress(generation: int, success: bool | None) -> GenerationStats:
    return stats(generation, mean_policy_success=success)


def compared(
    name: str, config: RunConfig, successes: Sequence[bool | None], **summary: object
) -> Compared:
    return Compared(name, config, [progress(g, s) for g, s in enumerate(successes, 1)], summary)


def rows(text: str) -> dict[str, list[str]]:
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    return {first: rest for first, *rest in cells}


def test_a_table_has_what_differs_and_what_came_out() -> None:
    other = configure(preset="thesis", seed=7, features=99)
    summary = {
        "mean_policy_return": -0.0619,
        "mean_policy_success": True,
        "robust_success_rate": 0.98,
    }
    runs = [
        compared(
            "a",
            RunConfig(),
            [False, False, True, True],
            **summary,
            parameters_sha256="0123456789abcdef",
        ),
        compared("b", other, [False, False]),
        compared("c", RunConfig(seed=1), [True]),
        compared("d", configure(preset="thesis", seed=7, features=50), [False]),
    ]
    cells = rows(table(runs))
    assert cells[""] == ["**a**", "**b**", "**c**", "**d**"]
    assert cells["preset"] == ["default", "own", "default", "own"]
    assert cells["seed"] == ["0", "7", "1", "7"]
    assert cells["features"] == ["-", "99", "-", "50"], "the kernel has none"
    assert cells["policy"] == ["kernel", "projected", "kernel", "projected"]
    assert cells["generations done"] == ["4", "2", "1", "1"]
    assert cells["rollouts"] == ["120", "60", "30", "30"]
    assert cells["return of the final policy"] == ["-0.062", "-", "-", "-"]
    assert cells["it succeeds"] == ["yes", "-", "-", "-"]
    assert cells["robust success"] == ["98%", "-", "-", "-"]
    # A generation shows the policy before its update
    assert cells["first success, generation"] == ["2", "-", "0", "-"]
    assert cells["hash"] == ["01234567", "-", "-", "-"]
    assert "gamma" not in cells  # the same everywhere
    assert {len(row) for row in cells.values()} == {4}
    screen = Console(width=80, file=io.StringIO(), force_terminal=False)
    screen.print(shown(runs))
    lines = screen.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[0].split() == ["a", "b", "c", "d"]
    assert ["robust", "success", "98%", "-", "-", "-"] in [line.split() for line in lines]
    assert len(lines) == len(cells) - 1, "a line each"


def test_a_table_of_tasks_without_success_says_nothing_of_it() -> None:
    cells = rows(table([compared(name, RunConfig(), [None, None]) for name in "ab"]))
    assert cells["generations done"] == ["2", "2"]
    assert not [name for name in cells if "succe" in name]


def test_names_are_as_short_as_they_can_be() -> None:
    assert names([Path("/x/runs/a"), Path("/x/runs/b/")]) == ["a", "b"]
    assert names([Path("/x/runs/a"), Path("/x/more/a"), Path("/x/more/b")]) == [
        "runs/a",
        "more/a",
        "more/b",
    ]
    with pytest.raises(ConfigError, match="is there twice"):
        names([Path("/x/a"), Path("/x/b/../a")])


def test_a_run_without_a_generation(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "r", RunConfig())
    with pytest.raises(ConfigError, match="has done no generation yet"):
        compare.read([folder])


def test_stored_means(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "r", RunConfig())
    for generation in (1, 2, 3):
        folder.append(progress(generation, False), np.full(4, generation + 0.5), np.ones(4), 3)
    assert folder.parameters.mean(2)[0].tolist() == [2.5] * 4
    for number, nearest in ((9, 3), (-4, 1)):
        with pytest.raises(ConfigError, match=f"stored are 1 to 3, the nearest is {nearest}"):
            folder.parameters.mean(number)
