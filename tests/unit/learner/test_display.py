"""The live screen: texts from workers and network do not disturb it."""

import io
import logging
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from made import stats
from rich.console import Console

from farm.net.telemetry import Report, WorkerStatus
from learner.commands.display import LiveDisplay, PlainDisplay

ATTACK = "\x1b[2J\x1b]0;owned\a\u202e\x9b3J [bold]"


def screen(
    workers: list[WorkerStatus],
    width: int,
    show: Callable[[], None] = lambda: None,
    validation: float | None = None,
) -> str:
    """The output for one generation on a terminal of this width."""
    at = SimpleNamespace(validated=SimpleNamespace(score=7.5, generation=2))
    learner = SimpleNamespace(
        config=SimpleNamespace(generations=3), state=SimpleNamespace(generation=0), at=at
    )
    pool = SimpleNamespace(census=lambda: workers)
    run = cast("Any", SimpleNamespace(learner=learner, pool=pool, recording=None, live=None))
    report = Report(progress=stats(ended=1, failed=1, validation=validation), rate=1.0)
    file = io.StringIO()
    with LiveDisplay(
        Console(file=file, force_terminal=True, width=width, color_system=None), run, []
    ) as display:
        show()
        display.show(report)
    return file.getvalue()


def worker(name: str, rate: float, host: str = "h") -> WorkerStatus:
    return WorkerStatus(
        worker=name,
        host=host,
        cores=1,
        version="1",
        fingerprint="c",
        rollouts=1,
        rate=rate,
        seen=1.0,
    )


def test_nothing_of_the_network_reaches_the_terminal_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(logging.root, "handlers", [])
    attacker = worker(f"w{ATTACK}/1", 1.0, f"h{ATTACK}")
    text = screen([attacker], 300, lambda: logging.getLogger().warning("it says %s", ATTACK))
    assert "it says \\x1b[2J" in text
    assert "h\\x1b[2J" in text
    for part in ("\x1b[2J", "\x1b]", "\a", "\u202e", "\x9b"):
        assert part not in text
    assert "[bold]" in text


def test_the_workers_rates_add_up_to_the_farms() -> None:
    text = screen([worker(f"h/{i}", 0.5 + i) for i in range(9)], 80)
    rates = [
        int(line.split("rollouts/s")[0].split()[-1])
        for line in text.splitlines()
        if "rollouts/s" in line
    ]
    parts = [
        int(line.split()[0])
        for line in text.splitlines()
        if "h/" in line or line.strip().endswith(" more")
    ]
    assert rates[-1] == sum(parts[-7:])


@pytest.mark.parametrize("width", [58, 80, 120])
def test_nothing_is_cut_off(width: int) -> None:
    text = screen([worker("lab-machine-3/123456", 1234.0, "lab-machine-3")], width)
    assert "…" not in text
    assert "1 rollouts ended early, 1 failed" in text


def test_validation_is_shown_where_it_is_measured() -> None:
    assert "validation" not in screen([], 80)
    assert re.search(
        r"validation +6\.500 +the mean policy's; best 7\.500 after generation 2",
        screen([], 80, validation=6.5),
    )


def test_the_line_of_a_generation_has_it_where_it_is_measured(
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = cast(
        "Any", SimpleNamespace(learner=SimpleNamespace(config=SimpleNamespace(generations=3)))
    )
    display = PlainDisplay(run, [])
    for value in (None, 6.5):
        display.show(Report(progress=stats(validation=value), rate=1.0))
    plain, validated = capsys.readouterr().out.splitlines()
    assert validated.replace("  validation    6.500", "") == plain
