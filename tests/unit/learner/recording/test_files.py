"""Compacting a recording: if the process is killed, its child ends as well, and its files are
removed later.
"""

import os
import select
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import rerun as rr
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from learner.recording import files

HANGS = """#!/bin/sh
for last; do :; done
echo half > "$last"
echo $$ > told
exec sleep 1000
"""
"""In place of Rerun: begins to write, and never ends."""

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux ends a process with its parent"
)


def killed_while_compacting(path: Path) -> None:
    """Compact a recording in another process, kill that, and see that the one it started ends as
    well.
    """
    folder = path.parent
    hangs, pipe = folder / "hangs", folder / "told"
    os.mkfifo(pipe)
    hangs.write_text(HANGS)
    hangs.chmod(0o755)
    code = (
        "import sys, pathlib; from learner.recording import files;"
        " files.compact(pathlib.Path(sys.argv[1]))"
    )
    environment = {**os.environ, "RERUN_CLI_PATH": str(hangs)}
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], cwd=folder, env=environment)
    child = os.pidfd_open(int(pipe.read_text()))
    process.kill()
    process.wait()
    exits, _, _ = select.select([child], [], [], 10)
    os.close(child)
    assert exits, "it goes on without its parent"


def test_no_process_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.rrd"
    path.write_text("recorded")
    killed_while_compacting(path)
    assert path.read_text() == "recorded"
    assert {each.name for each in tmp_path.glob("*merging*")} == {"run.merging.rrd", "run.merging"}
    monkeypatch.setenv("RERUN_CLI_PATH", "false")  # what cannot be compacted stays as it is
    assert files.next_part(path) == tmp_path / "run.part2.rrd"
    assert path.read_text() == "recorded"
    assert not list(tmp_path.glob("*merging*"))


def test_a_recording_without_an_end_is_read_in_silence(tmp_path: Path) -> None:
    """As after kill -9: Rerun warns of such a file."""
    stream = rr.RecordingStream("killed")
    stream.save(tmp_path / "open.rrd")
    stream.set_time("generation", sequence=3)
    stream.log("learning/return", rr.Scalars(1.0))
    stream.flush()
    shutil.copy(tmp_path / "open.rrd", tmp_path / "run.rrd")
    stream.disconnect()
    before = (tmp_path / "run.rrd").read_bytes()
    with pytest.warns(RerunWarning, match="no footer"):
        RrdReader(tmp_path / "run.rrd")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert files.last_generation(tmp_path / "run.rrd") == 3
    assert (tmp_path / "run.rrd").read_bytes() == before, "it needed no repair"


def test_what_was_left_goes_although_there_is_nothing_to_compact(tmp_path: Path) -> None:
    (tmp_path / "run.merging").mkdir()
    (tmp_path / "run.merging.rrd").touch()
    assert files.next_part(tmp_path / "run.rrd") == tmp_path / "run.rrd"
    assert not list(tmp_path.iterdir())


def test_rerun_sends_no_usage_data_and_says_nothing_of_it(tmp_path: Path) -> None:
    command = [files.program(), "analytics", "config"]
    process = subprocess.run(
        command, env=files.quiet(tmp_path), capture_output=True, text=True, check=True
    )
    assert '"analytics_enabled":false' in process.stdout.replace(" ", "").replace("\n", "")
    assert "usage data" not in process.stdout + process.stderr
