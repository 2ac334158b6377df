"""The live screen: what workers and their network say moves none of it."""

import io
import logging
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from farm.net.stats import GenerationStats
from farm.net.telemetry import WorkerStatus
from learner.commands.display import LiveDisplay
from learner.telemetry.report import Report

ATTACK = "\x1b[2J\x1b]0;owned\a\u202e\x9b3J [bold]"


def test_nothing_of_the_network_reaches_the_terminal_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.root, "handlers", [])
    worker = WorkerStatus(
        worker=f"w{ATTACK}/1", host=f"h{ATTACK}", cores=1, version="1", canary="c", rollouts=1, rate=1.0, seen=1.0
    )
    learner = SimpleNamespace(config=SimpleNamespace(generations=3), state=SimpleNamespace(generation=0))
    farm = SimpleNamespace(census=lambda: [worker])
    run = cast("Any", SimpleNamespace(learner=learner, farm=farm, recording=None, live=None))
    numbers = dict.fromkeys(GenerationStats.__dataclass_fields__, 1)
    progress = GenerationStats(**cast("Any", numbers))
    report = Report(progress=progress, rate=1.0, sample=None, traces={}, replay=None, replay_generation=0)
    file = io.StringIO()
    with LiveDisplay(Console(file=file, force_terminal=True, width=300, color_system=None), run, []) as shown:
        logging.getLogger().warning("it says %s", ATTACK)
        shown.show(report)
    said = file.getvalue()
    assert "it says \\x1b[2J" in said
    assert "h\\x1b[2J" in said
    for part in ("\x1b[2J", "\x1b]", "\a", "\u202e", "\x9b"):
        assert part not in said
    assert "[bold]" in said
