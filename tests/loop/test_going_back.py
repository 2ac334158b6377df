"""A run goes back to before an expelled host's first answer: what a liar costs, and that nothing of
it is left.
"""

import threading
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hosts import (
    LIES,
    Late,
    file_of,
    finished,
    honest_answers,
    host,
    learnt,
    placed,
    refused,
    shifted,
    tls,
)
from recordings import generations

from farm.net.session import listen
from farm.net.tls import find
from farm.net.work import Results
from learner.commands import learner as learner_command
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.launch import Run, open_run
from learner.run.states import RolledBack


def all_but_the_best(values: np.ndarray) -> np.ndarray:
    return np.where(values == values.max(), values, values - 0.01 * abs(values))


UNDONE = {
    "the last bit": (LIES["the last bit"], lambda _: True),
    "one percent": (LIES["one percent"], lambda _: True),
    "one message in three": (LIES["the last bit"], lambda count: count % 3 == 0),
    "all but its best": (shifted(all_but_the_best), lambda _: True),
}
"""Lies, and in which of the results from the fourth on."""


@pytest.mark.parametrize(
    "name",
    [
        name if name == "all but its best" else pytest.param(name, marks=pytest.mark.slow)
        for name in UNDONE
    ],
)
def test_a_liar_costs_time_and_no_number(
    certs: Path, config: RunConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """The liar is alone at first, so that its lies are in the state."""
    (forge, which), config, file = UNDONE[name], replace(config, generations=12), file_of(config)
    lie, place = Late(forge, 4, which), placed(certs, 1.0)
    with open_run(config, tmp_path / "honest", place) as run, host(place.listen, certs, "a", file):
        honest = finished(run)
    place, rows, hosts = placed(certs, 1.0), list[int](), ExitStack()
    joining, answered = threading.Event(), threading.Event()

    def waiting(message: Any) -> Any:
        # The second host builds the task first, which takes longer than the run
        if joining.is_set():
            answered.wait(30)
        return lie(message)

    def answering(message: Any) -> Any:
        if isinstance(message, Results):
            answered.set()
        return message

    def join() -> None:
        joining.set()
        hosts.enter_context(host(place.listen, certs, "a", file, answering))

    def learn(run: Run) -> None:
        for report in run.learn():
            rows.append(report.generation)
            if len(rows) == 6:  # at least one lie is in them
                join()

    with hosts:
        with open_run(config, tmp_path / "r", place) as run:
            hosts.enter_context(host(place.listen, certs, "liar", file, waiting))
            with pytest.raises(RolledBack):
                learn(run)
        with open_run(config, tmp_path / "r", place, resume=True) as run:
            assert run.learner.state.generation == 0, "the liar answered in the first generation"
            if not joining.is_set():  # the checker was faster
                join()
            assert finished(run) == honest
    lines = run.learner.folder.progress()
    assert [line.generation for line in lines] == list(range(1, 13)), "none is doubled"
    assert [line.rollouts for line in lines] == [12 * each for each in range(1, 13)]
    assert run.summary["undone"] == rows[-1]
    assert refused(caplog) == {"liar"}
    assert len(run.learner.folder.parameters.rows()) == 12


@pytest.mark.slow
def test_a_run_goes_back_no_further_than_the_liars_first_answer(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file = placed(certs, 1.0), file_of(config)
    with (
        open_run(replace(config, generations=3), tmp_path / "r", place) as run,
        host(place.listen, certs, "a", file),
    ):
        finished(run)
    place = placed(certs, 1.0)
    with open_run(config, tmp_path / "r", place, resume=True) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, LIES["the last bit"]))
        with pytest.raises(RolledBack, match="generation 3,"):
            finished(run)
    place = placed(certs, 1.0)
    with (
        open_run(config, tmp_path / "r", place, resume=True) as run,
        host(place.listen, certs, "a", file),
    ):
        assert run.learner.state.generation == 3
        assert finished(run) == honest
    assert sorted(each.name for each in (tmp_path / "r" / "states").iterdir()) == ["0", "3"]


@pytest.mark.slow
def test_an_expelled_host_is_not_admitted_by_a_resume(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hosts = {"liar": LIES["the last bit"], "a": honest_answers}
    half = replace(config, generations=3)
    run, _ = learnt(half, tmp_path / "r", certs, 1.0, hosts)
    expelled = checkpoints.load(run.learner.folder.checkpoint).expelled
    assert list(expelled) == ["liar"]
    caplog.clear()
    assert learnt(config, tmp_path / "r", certs, 0.0, hosts, resume=True)[1] == honest
    assert refused(caplog) == {"liar"}
    assert f"is refused: {expelled['liar']}" in caplog.text


@pytest.mark.slow
def test_an_expulsion_is_saved_before_the_generation_ends(
    certs: Path, config: RunConfig, tmp_path: Path
) -> None:
    place, file = placed(certs, 1.0), file_of(config)
    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        saved = list[tuple[int, list[str]]]()
        save = RunFolder.save

        def noted(folder: RunFolder, at: Checkpoint, **how: bool) -> None:
            save(folder, at, **how)
            saved.append(
                (at.state["generation"], list(checkpoints.load(folder.checkpoint).expelled))
            )

        hosts.enter_context(host(place.listen, certs, "liar", file, LIES["one percent"]))
        hosts.enter_context(host(place.listen, certs, "a", file))
        with pytest.MonkeyPatch.context() as patched, suppress(RolledBack):
            patched.setattr(RunFolder, "save", noted)
            finished(run)
    first = next(at for at, (_, expelled) in enumerate(saved) if expelled)
    before, after = saved[first - 1] if first else (0, []), saved[first]
    assert after[0] == before[0], "it is saved with the state from before the generation under way"


@pytest.mark.slow
def test_the_command_goes_on_by_itself_and_no_generation_is_recorded_twice(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, bundle, file = tls(), find(certs, "learner"), file_of(config)
    monkeypatch.chdir(tmp_path)
    words = [
        *configs.flags(config),
        "--connect",
        endpoint,
        "--tls",
        str(certs / "learner"),
        "--audit",
        "1",
    ]
    lied, hosts = threading.Event(), ExitStack()

    def lie(message: Any) -> Any:
        if isinstance(message, Results) and message.round > 3:
            lied.set()
            return LIES["the last bit"](message)
        return message

    def come() -> None:
        assert lied.wait(30)
        hosts.enter_context(host(endpoint, certs, "a", file))

    with listen(endpoint, "farm", bundle), hosts:
        hosts.enter_context(host(endpoint, certs, "liar", file, lie))
        coming = threading.Thread(target=come)
        coming.start()
        assert learner_command.main([*words, "--name", "r", "--quiet"]) == 0
        coming.join()
    folder = RunFolder(tmp_path / "runs" / "r")
    summary = folder.read_summary()
    assert summary is not None
    assert (summary["parameters_sha256"], summary["generations"], summary["state"]) == (
        honest,
        6,
        "finished",
    )
    assert summary["undone"] > 0
    assert generations(folder.recording) == list(range(1, 7))
    assert generations(folder.path / "undone.rrd") == list(range(1, summary["undone"] + 1))
    assert "the run goes back to generation 0" in (folder.path / "log.txt").read_text()
