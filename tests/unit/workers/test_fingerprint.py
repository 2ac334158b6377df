"""The canary changes with anything that changes a number, and with nothing else."""

import subprocess
import sys

import numpy as np
import pytest

from farm.policies import fourier as policy
from farm.tasks.finger_gait import physics as simulation
from farm.tasks.finger_gait import rewards
from farm.tasks.finger_gait import touch as tactile
from workers import fingerprint as canary


def fresh() -> str:
    canary.digest.cache_clear()
    return canary.digest()


def test_every_process_says_the_same() -> None:
    command = [sys.executable, "-c", "from workers import canary; print(canary.digest())"]
    other = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert other == fresh()


def _tactile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tactile, "KAPPA", np.nextafter(tactile.KAPPA, 9.0))


def _reward(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = rewards.discounted
    monkeypatch.setattr(rewards, "discounted", lambda terms, *scales: whole(np.nextafter(terms, 1.0), *scales))


def _policy(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = policy.Policy.features
    monkeypatch.setattr(policy.Policy, "features", lambda self, x: np.nextafter(whole(self, x), 1.0))


def _kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = policy.Policy._kernel
    monkeypatch.setattr(policy.Policy, "_kernel", lambda self, theta, x: np.nextafter(whole(self, theta, x), 2.0))


def _physics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "CLOSING", simulation.CLOSING + 1)


@pytest.mark.parametrize("change", [_tactile, _reward, _policy, _kernel, _physics])
def test_the_last_bit_of_anything_shows(monkeypatch: pytest.MonkeyPatch, change) -> None:
    before = fresh()
    change(monkeypatch)
    assert fresh() != before
    monkeypatch.undo()
    assert fresh() == before
