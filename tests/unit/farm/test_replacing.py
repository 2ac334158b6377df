"""A file is written whole, or stays as it was, with nothing beside it."""

from pathlib import Path

import pytest

from farm.replacing import replacing


def test_a_whole_file_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    path.write_text("old")
    with replacing(path) as aside:
        assert aside.suffix == ".gif"
        aside.write_text("new")
        assert path.read_text() == "old"
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("film.gif", "new")]


@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt()])
def test_after_an_error_the_old_file_stays(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "film.gif"
    path.write_text("old")

    def write() -> None:
        with replacing(path) as aside:
            aside.write_text("half")
            raise error

    with pytest.raises(type(error)):
        write()
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("film.gif", "old")]


def test_what_a_killed_process_left_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    (tmp_path / ".run.new.rrd").write_text("half")
    with replacing(path) as aside:
        assert not aside.exists()
        aside.write_text("whole")
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("run.rrd", "whole")]


def test_a_file_of_the_user_is_not_taken_for_what_was_left(tmp_path: Path) -> None:
    (tmp_path / "run.new.rrd").write_text("the user's")
    with replacing(tmp_path / "run.rrd") as aside:
        aside.write_text("whole")
    assert (tmp_path / "run.new.rrd").read_text() == "the user's"
