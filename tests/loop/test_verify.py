"""Verifying whole runs: learnt again on workers, every number is the same, or the first other one
is named.
"""

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from made import pole

import farm
from farm.__main__ import main
from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.launch import open_run
from learner.tools.verify import command


@pytest.mark.slow
def test_a_whole_run_is_repeated_on_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    config = farm.configure(f"{pole(tmp_path)}:Pole", generations=4, pairs=3)
    for _ in farm.learn(config, tmp_path / "r", workers=1):
        pass
    assert main(["verify", str(tmp_path / "r"), "--all", "--workers", "1"]) == 0
    assert "verified to the bit: 4 of 4 generations" in capsys.readouterr().out
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    (tmp_path / "r" / "summary.json").write_text(
        json.dumps(summary | {"robust_return": summary["robust_return"] + 1})
    )
    words = ["verify", str(tmp_path / "r"), "--all", "--workers", "1"]
    assert main([*words, "--receipt", str(tmp_path / "r.json")]) == 1
    assert "robust_return is" in capsys.readouterr().err
    assert json.loads((tmp_path / "r.json").read_text())["verdict"] == "different"
    assert not (tmp_path / "r.json.run").exists(), "there is nothing to continue"


@pytest.mark.slow
def test_results_that_are_called_interrupted_are_compared_as_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = farm.configure(f"{pole(tmp_path)}:Pole", generations=3, pairs=3)
    for _ in farm.learn(config, tmp_path / "r", workers=1):
        pass
    path = tmp_path / "r" / "summary.json"
    summary = json.loads(path.read_text()) | {"state": "interrupted"}
    path.write_text(json.dumps(summary | {"mean_policy_return": 99.0}))
    assert main(["verify", str(tmp_path / "r"), "--all", "--workers", "1"]) == 1
    assert "mean_policy_return is 99.0 in summary.json" in capsys.readouterr().err
    path.write_text(json.dumps(summary | {"mean_policy_return": None}))
    assert main(["verify", str(tmp_path / "r"), "--all", "--workers", "1"]) == 0, (
        "a run without an end has no results"
    )


@pytest.mark.slow
def test_an_interrupted_repetition_of_the_whole_run_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = farm.configure(f"{pole(tmp_path)}:Pole", generations=6, pairs=3)
    for _ in farm.learn(config, tmp_path / "r", workers=1):
        pass
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    words, repeated = ["verify", str(tmp_path / "r"), "--all", "--workers", "1"], command.verify_all
    words += ["--receipt", str(tmp_path / "r.json")]

    def pressed(*values: Any) -> Iterator[tuple[int, int]]:
        for count, result in enumerate(repeated(*values), 1):
            if count == 3:
                signal.raise_signal(signal.SIGINT)
            yield result

    with monkeypatch.context() as patched:
        patched.setattr(command, "verify_all", pressed)
        assert main(words) == 130
    assert json.loads((tmp_path / "r.json").read_text())["generations"] == [1, 2, 3]
    assert (tmp_path / "r.json.run").is_dir()
    assert main(words) == 0
    receipt = json.loads((tmp_path / "r.json").read_text())
    assert (receipt["generations"], receipt["rollouts"], receipt["verdict"]) == (
        [1, 2, 3, 4, 5, 6],
        36,
        "the same",
    )
    assert not (tmp_path / "r.json.run").exists()


@pytest.mark.slow
def test_a_share_is_repeated_on_workers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = farm.configure(
        f"{pole(tmp_path)}:Pole", generations=4, pairs=3, normalise=True, policy="linear"
    )
    for _ in farm.learn(config, tmp_path / "r", workers=1):
        pass
    assert main(["verify", str(tmp_path / "r"), "--share", "1", "--workers", "2"]) == 0
    assert "verified to the bit: 4 of 4 generations" in capsys.readouterr().out


@pytest.mark.slow
def test_a_chain_does_not_tell_workers_or_interruptions(tmp_path: Path) -> None:
    config = farm.configure(f"{pole(tmp_path)}:Pole", generations=5, pairs=3)
    for report in farm.learn(config, tmp_path / "a", workers=1):
        if report.progress.generation == 2:
            break
    place = Placement(workers=2, listen=free_endpoint())
    with open_run(config, tmp_path / "a", place, resume=True) as again:
        for _ in again.learn():
            pass
    for _ in farm.learn(config, tmp_path / "b", workers=1):
        pass
    chains = [(tmp_path / name / "chain").read_text() for name in ("a", "b")]
    assert chains[0] == chains[1]
    assert chains[0].splitlines()[-1].split()[1] == again.summary["chain"]
