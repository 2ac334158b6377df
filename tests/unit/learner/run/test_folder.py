"""A run's folder: appended entries are read back exactly, incomplete ends are cut off, nothing is
overwritten.
"""

import json
import os
from dataclasses import replace
from pathlib import Path

import made
import numpy as np
import pytest
from made import stats

from farm.errors import CheckpointError, ConfigError
from farm.net.stats import GenerationStats
from learner.algorithms import PGPE
from learner.run import files
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

P = 5
RNG = np.random.default_rng(1)
ROWS = {g: (RNG.normal(size=P) * 10.0**g, RNG.uniform(size=P)) for g in range(1, 31)}


def progress(generation: int) -> GenerationStats:
    return stats(
        generation,
        return_mean=-1 / generation,
        return_min=-4e300,
        return_max=-1e-300,
        return_std=np.pi,
        baseline=None,
        mean_policy_return=-1 / 3,
        mean_policy_success=generation % 2 == 0,
        seconds=1.5 * generation,
    )


def checkpoint(generation: int) -> Checkpoint:
    return made.checkpoint(state=replace(PGPE().init(P), generation=generation).to_dict())


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "runs" / "r", RunConfig(seed=4))


def fill(folder: RunFolder, last: int, first: int = 1, generations: int = 10) -> None:
    for generation in range(first, last + 1):
        folder.append(progress(generation), *ROWS[generation], generations)


def assert_holds(folder: RunFolder, generations: list[int]) -> None:
    rows = folder.parameters.rows()
    assert rows["generation"].tolist() == generations
    for row in rows:
        mu, sigma = ROWS[int(row["generation"])]
        assert row["mu"].tobytes() == mu.tobytes()
        assert row["sigma"].tobytes() == sigma.tobytes()


def test_created_once(folder: RunFolder) -> None:
    assert folder.name == "r"
    assert RunFolder.open(folder.path).read_config() == RunConfig(seed=4)
    with pytest.raises(
        ConfigError, match="exists and is never overwritten: choose a different --name, or --resume"
    ):
        RunFolder.create(folder.path, RunConfig())
    assert folder.read_config() == RunConfig(seed=4)


def test_where_no_folder_can_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot make the run folder .*: .*file is a file"):
        RunFolder.create(tmp_path / "file" / "r", RunConfig())
    with pytest.raises(ConfigError, match="is not a run's folder: it has no config.json"):
        RunFolder.open(tmp_path)


@pytest.mark.parametrize(
    ("given", "meant"),
    [("runs/swng", "runs/swing"), ("swing", "runs/swing"), ("there/reechd", "there/reached")],
)
def test_a_mistyped_run_is_guessed(
    given: str, meant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("runs/swing", "runs/other", "there/reached"):
        RunFolder.create(Path(name), RunConfig())
    with pytest.raises(
        ConfigError,
        match=f"^{given} is not a run's folder: it does not exist; did you mean {meant}\\?$",
    ):
        RunFolder.open(Path(given))
    with pytest.raises(ConfigError, match="is not a run's folder: it does not exist$"):
        RunFolder.open(Path("runs/quite-another"))


def test_no_configuration_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        ConfigError, match="cannot write to the run folder .*: No space left on device"
    ):
        RunFolder.create(tmp_path / "r", RunConfig())
    assert not (tmp_path / "r").exists()


def test_one_process_at_a_time(folder: RunFolder) -> None:
    with folder.held():
        with (
            pytest.raises(ConfigError, match="another process is working on the run in"),
            folder.held(),
        ):
            pass
    with folder.held():
        pass


def test_read_back_exactly(folder: RunFolder) -> None:
    fill(folder, 10)
    assert folder.progress() == [progress(g) for g in range(1, 11)]
    assert_holds(folder, list(range(1, 11)))
    with (folder.path / "parameters").open("rb") as file:  # as docs/files.md says
        head = json.loads(file.readline())
        size = head["parameters"]
        rows = np.frombuffer(
            file.read(), [("generation", "<i8"), ("mu", "<f8", size), ("sigma", "<f8", size)]
        )
    assert (head["version"], head["every"]) == (1, 1)
    assert rows["generation"].tolist() == list(range(1, 11))
    assert rows["mu"][3].tobytes() == ROWS[4][0].tobytes()


def test_means_are_averaged_over_the_last_generations(folder: RunFolder) -> None:
    fill(folder, 6)
    mu = ROWS[6][0]
    assert folder.parameters.average(6, mu, 1) is mu
    np.testing.assert_array_equal(
        folder.parameters.average(6, mu, 3), (ROWS[4][0] + ROWS[5][0] + mu) / 3
    )
    whole = sum(ROWS[g][0] for g in range(1, 7)) / 6
    np.testing.assert_array_equal(folder.parameters.average(6, mu, 6), whole)
    np.testing.assert_array_equal(folder.parameters.average(6, mu, 100), whole)  # there are no more
    np.testing.assert_array_equal(folder.parameters.average(1, mu, 100), mu)


def test_means_that_are_not_stored_are_not_averaged(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    np.testing.assert_array_equal(folder.parameters.average(6, ROWS[6][0], 3), ROWS[6][0])
    assert (
        "parameters lacks means of generations 4 to 5: the average is of 1 instead of 3"
        in caplog.text
    )
    monkeypatch.setattr(files, "PARAMETERS_LIMIT", 440)  # every second generation is stored
    fill(folder, 7)
    np.testing.assert_array_equal(
        folder.parameters.average(7, ROWS[7][0], 4), (ROWS[4][0] + ROWS[6][0] + ROWS[7][0]) / 3
    )
    np.testing.assert_array_equal(folder.parameters.average(12, ROWS[12][0], 4), ROWS[12][0])
    assert "lacks means of generations 9 to 11: the average is of 1 instead of 2" in caplog.text


@pytest.mark.parametrize(("limit", "every"), [(880, 1), (879, 2), (440, 2), (439, 3), (87, 11)])
def test_beyond_the_limit_every_kth_is_kept(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, limit: int, every: int
) -> None:
    monkeypatch.setattr(files, "PARAMETERS_LIMIT", limit)  # ten rows of 88 bytes
    assert folder.parameters.every(P, 10) == every
    fill(folder, 10)
    assert folder.parameters.every(P, 10) == every
    assert_holds(folder, list(range(every, 11, every)))
    assert folder.parameters.rows().nbytes <= limit


def test_a_longer_run_keeps_its_rhythm(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "PARAMETERS_LIMIT", 440)
    fill(folder, 10)
    fill(folder, 30, first=11, generations=30)
    assert folder.parameters.every(P, 30) == 2
    assert_holds(folder, list(range(2, 31, 2)))


def test_torn_ends_are_not_read(folder: RunFolder) -> None:
    fill(folder, 4)
    lines, parameters = folder.path / "progress.jsonl", folder.path / "parameters"
    whole, bytes_ = lines.read_bytes(), parameters.read_bytes()
    start = whole.rindex(b"\n", 0, -1) + 1
    for cut in range(start, len(whole) - 1, 9):
        lines.write_bytes(whole[:cut])
        assert [p.generation for p in folder.progress()] == [1, 2, 3]
    for cut in (1, 8, 44, 87):
        parameters.write_bytes(bytes_[:-cut])
        assert_holds(folder, [1, 2, 3])


@pytest.mark.parametrize(
    "tail",
    [b"\0" * 50, b"\xff\xfe\n", b"[]\n", b"null\n", b'{"version": 1}\n', b'{"version": 2}\n'],
)
def test_rubbish_is_not_read(folder: RunFolder, tail: bytes) -> None:
    fill(folder, 3)
    with (folder.path / "progress.jsonl").open("ab") as file:
        file.write(tail)
    assert [p.generation for p in folder.progress()] == [1, 2, 3]
    folder.truncate(checkpoint(3))
    fill(folder, 4, first=4)
    assert folder.progress() == [progress(g) for g in range(1, 5)]


def damage(folder: RunFolder, *changes: tuple[int, bytes]) -> bytes:
    path = folder.path / "progress.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in changes:
        lines[number - 1] = line
    path.write_bytes(b"".join(lines))
    return path.read_bytes()


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"\x80\0 \n",
        b'{"version": 2}\n',
        b"[" * 100_000 + b"\n",
        b'{"version": 1' + b"1" * 5000 + b"}\n",
    ]
    + [(json.dumps(progress(g).to_dict()) + "\n").encode() for g in (1, 3, 9000)],
    ids=[
        "empty",
        "noise",
        "fields",
        "nested",
        "digits",
        "an older one",
        "doubled",
        "of the future",
    ],
)
def test_a_damaged_line_costs_no_other(
    folder: RunFolder, caplog: pytest.LogCaptureFixture, line: bytes
) -> None:
    fill(folder, 7)
    content = damage(folder, (4, line))
    rest = [progress(g) for g in (1, 2, 3, 5, 6, 7)]
    assert folder.progress() == rest
    folder.truncate(checkpoint(6))
    assert folder.progress() == rest[:-1]
    copy = folder.path / "progress.jsonl.damaged"
    assert copy.read_bytes() == content
    (message,) = caplog.messages
    assert "1 damaged line(s) dropped (line 4), 5 kept" in message or "(line 3), 5 kept" in message
    assert str(copy) in message

    content = damage(folder, (2, b"{}\n"), (3, b"}\n"))
    folder.truncate(checkpoint(6))
    assert copy.read_bytes() != content
    assert copy.with_name("progress.jsonl.damaged2").read_bytes() == content
    assert "2 damaged line(s) dropped (line 2, 3), 3 kept" in caplog.messages[1]
    folder.truncate(checkpoint(6))
    assert len(caplog.messages) == 2
    fill(folder, 7, first=7)
    assert [p.generation for p in folder.progress()] == [1, 5, 6, 7]


def test_an_end_torn_off_before_the_checkpoint_is_kept(
    folder: RunFolder, caplog: pytest.LogCaptureFixture
) -> None:
    fill(folder, 3)
    path = folder.path / "progress.jsonl"
    torn = path.read_bytes()[:-30]
    path.write_bytes(torn)
    folder.truncate(checkpoint(3))
    assert (folder.path / "progress.jsonl.damaged").read_bytes() == torn
    assert "1 damaged line(s) dropped (line 3), 2 kept" in caplog.text


def test_a_crash_tears_off_an_end_without_a_word(
    folder: RunFolder, caplog: pytest.LogCaptureFixture
) -> None:
    fill(folder, 4)
    path = folder.path / "progress.jsonl"
    path.write_bytes(path.read_bytes()[:-30])
    folder.truncate(checkpoint(3))
    assert not caplog.messages
    assert not list(folder.path.glob("*.damaged*"))


def test_parameters_that_end_before_the_checkpoint_are_refused(folder: RunFolder) -> None:
    fill(folder, 3)
    with pytest.raises(
        CheckpointError,
        match=r"ends with generation 3, the checkpoint is of 5; if there is a checkpoint\.safe",
    ):
        folder.truncate(checkpoint(5))
    assert_holds(folder, [1, 2, 3])
    (folder.path / "parameters").unlink()
    folder.truncate(checkpoint(5))


def test_what_cannot_be_copied_is_not_cut(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(folder, 3)
    content = damage(folder, (2, b"{}\n"))

    def full(_: object, to: Path) -> None:
        to.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        folder.truncate(checkpoint(3))
    assert (folder.path / "progress.jsonl").read_bytes() == content
    assert not list(folder.path.glob("*.damaged*"))


def test_cut_back_to_the_checkpoint(folder: RunFolder) -> None:
    fill(folder, 5)
    lines, parameters = folder.path / "progress.jsonl", folder.path / "parameters"
    after_five = lines.read_bytes(), parameters.read_bytes()
    fill(folder, 7, first=6)
    for path, torn in ((lines, b'{"version": 2, "gen'), (parameters, b"\1" * 50)):
        with path.open("ab") as file:
            file.write(torn)
    folder.truncate(checkpoint(5))
    assert (lines.read_bytes(), parameters.read_bytes()) == after_five
    folder.truncate(checkpoint(5))
    assert (lines.read_bytes(), parameters.read_bytes()) == after_five
    folder.truncate(checkpoint(0))
    assert folder.progress() == []
    assert_holds(folder, [])
    fill(folder, 5)
    assert (lines.read_bytes(), parameters.read_bytes()) == after_five


def test_cut_back_before_the_first_generation(folder: RunFolder) -> None:
    folder.truncate(checkpoint(0))
    assert folder.progress() == []
    assert not (folder.path / "parameters").exists()


def test_a_checkpoint_without_generation(folder: RunFolder) -> None:
    with pytest.raises(CheckpointError, match="holds no generation"):
        folder.truncate(replace(checkpoint(1), state={"generation": "one"}))


def test_parameters_are_begun_whole_or_not_at_all(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an incomplete head the run could not continue."""

    def full(path: Path, *_: object) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        fill(folder, 1)
    monkeypatch.undo()
    folder.truncate(checkpoint(0))
    fill(folder, 1)
    assert folder.progress() == [progress(1)]
    assert_holds(folder, [1])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "has no readable first line"),
        (b"\x93\n", "has no readable first line"),
        (b'{"version": 7}\n', "is not of version 1"),
        (b"3\n", "is not of version 1"),
        (b"[" * 990, "has no readable first line"),
        *(
            (
                f'{{"version": 1, "parameters": {size}, "every": {every}}}\n'.encode() + b"\1" * 80,
                "is damaged: ",
            )
            for size, every in (
                (-1, 1),
                (0, 1),
                ("true", 1),
                ('"5"', 1),
                (10**30, 1),
                ("[]", 1),
                (1, 0),
                (1, 1.5),
                (1, 7),
            )
        ),
    ],
)
def test_parameters_that_are_none(folder: RunFolder, content: bytes, words: str) -> None:
    (folder.path / "parameters").write_bytes(content)
    with pytest.raises(ConfigError, match=words):
        folder.parameters.rows()


def test_a_wrong_count_of_parameters_cuts_nothing(folder: RunFolder) -> None:
    fill(folder, 3)
    path = folder.path / "parameters"
    path.write_bytes(path.read_bytes().replace(b'"parameters": 5', b'"parameters": 4'))
    before = path.read_bytes(), (folder.path / "progress.jsonl").read_bytes()
    with pytest.raises(
        ConfigError, match="is damaged: its generations do not rise .* moved elsewhere"
    ):
        folder.truncate(checkpoint(1))
    path.write_bytes(before[0].replace(b'"parameters": 4', b'"parameters": 500'))
    with pytest.raises(
        ConfigError, match="is of 500 parameters, the checkpoint of 5: moved elsewhere"
    ):
        folder.truncate(checkpoint(1))
    for rest in (b'5, "observation": 900', b'5, "observation": 1'):
        path.write_bytes(before[0].replace(b'"parameters": 4', b'"parameters": ' + rest))
        with pytest.raises(ConfigError, match="is damaged: .* moved elsewhere"):
            folder.truncate(checkpoint(1))
    assert (folder.path / "progress.jsonl").read_bytes() == before[1]
    path.rename(path.with_name("old"))
    folder.truncate(checkpoint(1))
    fill(folder, 2, first=2)
    assert_holds(folder, [2])


def test_summaries(folder: RunFolder) -> None:
    assert folder.read_summary() is None
    folder.write_summary({"run": "r", "best_return": None})
    assert folder.read_summary() == {"run": "r", "best_return": None}
    for content in ("", "{", "[]", "[" * 100_000):
        (folder.path / "summary.json").write_text(content)
        assert folder.read_summary() is None


def test_a_new_run_can_be_discarded(folder: RunFolder) -> None:
    folder.discard()
    assert not folder.path.exists()


def test_normalisers_are_kept_where_there_are_some(folder: RunFolder) -> None:
    normalisers = np.random.default_rng(0).uniform(size=(4, 2, 3))
    for generation in (1, 2, 3):
        folder.append(progress(generation), *ROWS[generation], 10, normalisers[generation])
    rows = folder.parameters.rows()
    assert rows["normaliser"].tobytes() == normalisers[1:].tobytes()
    mu, normaliser = folder.parameters.mean(2)
    assert (mu.tobytes(), normaliser.tobytes()) == (ROWS[2][0].tobytes(), normalisers[2].tobytes())
    assert "normaliser" in (folder.path / "parameters").read_bytes().partition(b"\n")[0].decode()


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", ["log.txt", "progress.jsonl"])
def test_something_that_is_no_file_is_not_waited_for(name: str, tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "r", RunConfig())
    os.mkfifo(folder.path / name)
    with pytest.raises(
        ConfigError, match=rf"{name} is not a file; expected one that the run wrote: remove it"
    ):
        RunFolder.open(folder.path)
