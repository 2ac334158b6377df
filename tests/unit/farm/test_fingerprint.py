"""The fingerprint changes if and only if the numbers change."""

import subprocess
import sys

import numpy as np
import pytest

from farm import fingerprint, plugins
from farm.policies import fourier
from farm.sim.sim import Sim
from farm.tasks import loop, rollouts


def fresh() -> str:
    """Computed now: the one that is kept for this process stays as it is."""
    return fingerprint.digest.__wrapped__()


def test_every_process_says_the_same() -> None:
    command = [sys.executable, "-c", "from farm import fingerprint; print(fingerprint.digest())"]
    other = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert other == fresh()


def _reward(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = rollouts.discounted
    monkeypatch.setattr(
        loop, "discounted", lambda terms, *scales: whole(np.nextafter(terms, 1.0), *scales)
    )


def _features(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fourier.Direct.features
    monkeypatch.setattr(
        fourier.Direct, "features", lambda self, x: np.nextafter(whole(self, x), 1.0)
    )


def _physics(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Sim.control
    monkeypatch.setattr(Sim, "control", lambda self, ctrl: whole(self, np.nextafter(ctrl, 1.0)))


@pytest.mark.parametrize("change", [_reward, _features, _physics])
def test_the_last_bit_of_anything_shows(monkeypatch: pytest.MonkeyPatch, change) -> None:
    before = fresh()
    change(monkeypatch)
    assert fresh() != before
    monkeypatch.undo()
    assert fresh() == before


@pytest.mark.parametrize("name", plugins.BUILT_IN["policies"])
def test_every_built_in_policy_counts(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    before, kind = fresh(), plugins.find("policies", name).target
    whole = kind.act

    def changed(self, *arguments):
        answer = whole(self, *arguments)
        action, *memory = answer if isinstance(answer, tuple) else (answer,)
        shifted = np.nextafter(action, 2.0)
        return (shifted, *memory) if memory else shifted

    monkeypatch.setattr(kind, "act", changed)
    assert fresh() != before
