"""Runs of many generations: what is asked of their progress reads a part of the file, not all of
it.
"""

import json
from pathlib import Path

import pytest
from made import stats

from learner.run import files
from learner.run.config import RunConfig
from learner.run.files import ProgressFile, with_rates
from learner.run.folder import RunFolder
from learner.tools.runs.command import _row

GENERATIONS = 20_000


def line(generation: int) -> str:
    return (
        json.dumps(stats(generation, rollouts=30 * generation, seconds=0.25 * generation).to_dict())
        + "\n"
    )


@pytest.fixture(scope="module")
def text() -> str:
    return "".join(line(generation) for generation in range(1, GENERATIONS + 1))


@pytest.fixture
def long(tmp_path: Path, text: str) -> RunFolder:
    folder = RunFolder.create(tmp_path / "long", RunConfig())
    (folder.path / "progress.jsonl").write_text(text)
    return folder


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A number for each line that is parsed."""
    calls: list[int] = []
    before = files._parsed

    def counted(line: str | bytes) -> object:
        calls.append(len(line))
        return before(line)

    monkeypatch.setattr(files, "_parsed", counted)
    return calls


def test_the_last_generation_is_at_the_end_of_the_file(long: RunFolder, parsed: list[int]) -> None:
    last = long.last_progress()
    assert last is not None
    assert last.generation == GENERATIONS
    assert sum(parsed) <= 1 << 16


def test_a_row_of_the_table_of_runs_reads_the_end(long: RunFolder, parsed: list[int]) -> None:
    assert _row(long)["generations"] == GENERATIONS
    assert sum(parsed) <= 1 << 16


@pytest.mark.parametrize("generation", [-5, 0, 1, 2, 777, 9_999, 19_998, 19_999, 20_000, 30_000])
def test_later_generations_are_found_without_reading_earlier_ones(
    long: RunFolder, parsed: list[int], generation: int
) -> None:
    found = [each.generation for each in long.progress_after(generation)]
    assert found == list(range(max(generation, 0) + 1, GENERATIONS + 1))
    assert len(parsed) < len(found) + 300


@pytest.mark.parametrize("generation", [0, 4_000, 4_999, 5_000, 5_001, 5_999, 6_000])
def test_damaged_lines_hide_no_others(tmp_path: Path, generation: int) -> None:
    path = tmp_path / "progress.jsonl"
    path.write_text(
        "".join("rubbish\n" if 5_000 <= each < 6_000 else line(each) for each in range(1, 8_001))
    )
    whole = [each for each in range(1, 8_001) if not 5_000 <= each < 6_000]
    expected = [each for each in whole if each > generation]
    assert [each.generation for each in ProgressFile(path).after(generation)] == expected


@pytest.mark.parametrize(
    "end", ["", '{"version": 2, "gener', "rubbish\n" * 20_000, "\n" * 100_000, "\xff\x00"]
)
def test_the_last_line_may_be_torn(tmp_path: Path, end: str) -> None:
    path = tmp_path / "progress.jsonl"
    path.write_bytes((line(1) + line(2)).encode() + end.encode("latin-1"))
    last = ProgressFile(path).last()
    assert last is not None
    assert last.generation == 2


def test_of_no_file_there_is_nothing(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    assert ProgressFile(path).last() is None
    assert list(ProgressFile(path).after(0)) == []
    path.touch()
    assert ProgressFile(path).last() is None
    assert list(ProgressFile(path).after(0)) == []


def test_a_sound_file_is_not_written_again(long: RunFolder) -> None:
    path = long.path / "progress.jsonl"
    before = path.stat().st_ino
    ProgressFile(path).truncate(GENERATIONS)
    assert path.stat().st_ino == before
    ProgressFile(path).truncate(GENERATIONS - 1)
    last = long.last_progress()
    assert last is not None
    assert last.generation == GENERATIONS - 1


def test_rates_follow_from_successive_lines() -> None:
    lines = [stats(1, rollouts=30, seconds=0.5), stats(2, rollouts=60, seconds=0.75)]
    assert [rate for _, rate in with_rates(lines)] == [60.0, 120.0]
