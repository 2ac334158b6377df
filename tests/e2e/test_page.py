"""`farm view --web`: one line, and not a word about usage data, which Rerun would collect."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rerun

from farm.processes import end

pytestmark = pytest.mark.slow


def test_a_page_is_served_in_one_line(tmp_path: Path) -> None:
    path, home = tmp_path / "some.rrd", tmp_path / "home"
    home.mkdir()
    with rerun.RecordingStream("some") as recording:
        recording.save(path)
        recording.log("value", rerun.Scalars(1.0))
    words = [sys.executable, "-m", "farm", "view", str(path), "--web"]
    environment = {"HOME": str(home), "PATH": "/usr/bin:/bin"}  # a first start, without a display
    process = subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        assert process.stdout
        assert process.stdout.readline().startswith("open http://127.0.0.1:")
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=30)
    finally:
        end([process], 5.0)
    assert output.split() == ["SIGTERM:", "closing", "the", "viewer"]
    assert list(home.iterdir()) == []
