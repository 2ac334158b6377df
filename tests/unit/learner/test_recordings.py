"""Where a recording may be written, and what can be opened: errors come before any work is done."""

from pathlib import Path

import pytest

from farm.errors import ConfigError
from learner.commands.recordings import sources, target


def test_a_new_name_also_in_folders_that_are_not_there_yet(tmp_path: Path) -> None:
    for name in ("a.rrd", "new/folder/a.rrd"):
        assert target(tmp_path / name) == tmp_path / name


def test_a_folder_or_a_name_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.rrd").mkdir()
    with pytest.raises(ConfigError, match=r"--to .*folder\.rrd: it is a folder; give another name"):
        target(tmp_path / "folder.rrd")
    for name in ("file/a.rrd", "file/new/a.rrd"):
        with pytest.raises(
            ConfigError, match=r"--to .*a\.rrd: .*file is a file; give another name"
        ):
            target(tmp_path / name)


def test_a_run_without_a_recording_is_not_taken_for_a_mistyped_name(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}", "utf-8")
    with pytest.raises(ConfigError, match=r"a \.rrd file$"):
        sources(str(tmp_path / "first"))
    with pytest.raises(ConfigError, match="did you mean .*first"):
        sources(str(tmp_path / "frist"))
