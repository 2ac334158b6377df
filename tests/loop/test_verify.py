"""Verifying whole runs: learnt again on workers, every number is the same, or the first other one is named."""

import json
from pathlib import Path

import pytest
from made import pole

import farm
from farm.__main__ import main


def test_a_whole_run_is_repeated_on_workers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = farm.configure(f"{pole(tmp_path)}:Pole", generations=4, pairs=3)
    for _ in farm.learn(config, tmp_path / "r", workers=1):
        pass
    assert main(["verify", str(tmp_path / "r"), "--all", "--workers", "1"]) == 0
    assert "verified to the bit: 4 of 4 generations" in capsys.readouterr().out
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    (tmp_path / "r" / "summary.json").write_text(json.dumps(summary | {"robust_return": summary["robust_return"] + 1}))
    assert main(["verify", str(tmp_path / "r"), "--all", "--workers", "1"]) == 1
    assert "robust_return is" in capsys.readouterr().err
