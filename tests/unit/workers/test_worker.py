"""A worker and a learner that follows a script: the order of messages, which runs are served, what
is ignored.
"""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import pole, spec_of
from stage import BEGINNING, FARM, WAIT, Learner, Runner, Stage, at_work, indices, until

from farm import plugins
from farm.errors import ConfigError
from farm.net import codec, keys
from farm.net.messages import Refusal, WorkRequest
from farm.net.session import connect
from farm.net.work import Results
from farm.sim.engines import CAPACITY
from workers import worker as workers
from workers.config import WorkerConfig


@pytest.mark.parametrize("_", range(3))
def test_a_visible_worker_can_be_reached(stage: Stage, _: int) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    name, alive = stage.next("worker")
    assert (name, alive) == (worker.id, True)
    learner.announce()
    learner.send(worker.id, 0)
    assert indices(stage.results()) == [0]


def test_it_says_what_it_wants(stage: Stage) -> None:
    Learner(stage.session, "r")
    worker = stage.hire()
    _, want = stage.next("want")
    assert isinstance(want, WorkRequest)
    assert (want.worker, want.credits, want.idle) == (worker.id, 2 * CAPACITY, ())


def test_it_asks_for_what_it_has_not_heard(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    for first in (0, 2):
        learner.send(worker.id, first, first + 1)
        answer = stage.results()
        assert (answer.run, answer.incarnation, answer.round, answer.worker) == (
            "r",
            "first",
            2,
            worker.id,
        )
        assert indices(answer) == [first, first + 1]
        assert answer.returns.tolist() == [3.0 + 3 * first, 6.0 + 3 * first]
    assert learner.asked == {"generation": 1, "spec": 1}
    assert Runner.builds == ["r"]


def test_work_of_an_old_round_is_given_up(stage: Stage) -> None:
    learner, worker = at_work(stage)
    learner.header = replace(learner.header, round=3)
    learner.announce()
    learner.send(worker.id, 3)
    until(lambda: stage.queued == 4)
    Runner.go.set()
    assert [
        (indices(results), results.round) for results in (stage.results(), stage.results())
    ] == [([0], 2), ([3], 3)]


def test_two_runs_in_turn(stage: Stage) -> None:
    learners = [Learner(stage.session, run) for run in ("a", "b")]
    worker = stage.hire()
    for _ in learners:
        stage.next("want")
    Runner.go.clear()
    learners[0].send(worker.id, 0)
    until(lambda: Runner.ran)
    for learner, numbers in zip(learners, ((1, 2), (0, 1, 2)), strict=True):
        for index in numbers:
            learner.send(worker.id, index)
    until(lambda: stage.queued == 5)
    Runner.go.set()
    answers = [stage.results("a", "b") for _ in range(6)]
    assert Runner.ran == ["a", "b", "a", "b", "a", "b"]
    assert [indices(answer) for answer in answers if answer.run == "b"] == [[0], [1], [2]]
    assert Runner.builds == ["a", "b"]


def test_a_learner_that_leaves_takes_its_work_along(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    with connect((stage.endpoint,), WAIT, lambda: False) as presence:
        learner = Learner(stage.session, "r", presence=presence)
        worker = stage.hire()
        learner.send(worker.id, 0)
        stage.results()
        stage.asked(lambda want: want.idle == ("r",))
    stage.asked(lambda want: want.idle == ())


def test_an_idle_worker_says_so(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    Learner(stage.session, "r")
    stage.hire()
    messages = [stage.next("want")[1] for _ in range(3)]
    assert [want.idle for want in messages if isinstance(want, WorkRequest)] == [(), ("r",), ("r",)]


def test_what_got_lost_of_one_run_is_noticed_while_another_keeps_it_busy(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    busy, _ = Learner(stage.session, "busy"), Learner(stage.session, "lost")
    worker = stage.hire()
    busy.send(worker.id, 0)
    while True:
        _, message = stage.next("result of busy", "want")
        if isinstance(message, Results):
            busy.send(worker.id, 0)
        elif isinstance(message, WorkRequest) and "lost" in message.idle:
            break


def test_a_worker_that_leaves_hands_back(stage: Stage) -> None:
    learner, worker = at_work(stage)
    until(lambda: stage.queued == 2)
    stage.let_go()
    Runner.go.set()
    messages: list[object] = []
    while len(messages) < 2:
        _, message = stage.next("result of r", "want")
        if not isinstance(message, WorkRequest) or message.credits == 0:
            messages.append(message)
    messages.sort(key=lambda message: isinstance(message, WorkRequest))
    done, want = messages
    assert isinstance(done, Results)
    assert isinstance(want, WorkRequest)
    assert indices(done) == [0], "what it has begun is done"
    assert want.idle == ("r",)


def test_a_task_it_does_not_know(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r", replace(BEGINNING, task="unknown"))
    worker = stage.hire()
    for _ in range(2):
        learner.send(worker.id, 4, 5)
        failure = stage.failure()
        assert failure.index is None, "it is not the job"
        assert failure.error == "not here"
    assert caplog.messages == ["cannot serve run r: not here"]
    assert caplog.records[0].exc_info in (None, False)
    assert learner.asked["spec"] == 1


def test_a_task_it_cannot_build(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r", replace(BEGINNING, task="broken"))
    worker = stage.hire()
    for _ in range(2):
        learner.send(worker.id, 0, 1)
        failure = stage.failure()
        assert failure.index is None, "it is not the job"
        assert failure.error == "RuntimeError: no such machine"
    assert learner.asked["spec"] == 1
    assert caplog.messages[0].startswith("cannot serve run r: RuntimeError: no such")
    assert caplog.records[0].exc_info is None, "its learner shows the traceback"


def test_a_job_that_fails_does_not_take_others_along(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.send(worker.id, 12, 13, 14)
    assert indices(stage.results()) == [12]
    failed = stage.failure()
    assert (failed.index, failed.error) == (13, "ArithmeticError: thirteen")
    assert (failed.run, failed.incarnation, failed.round, failed.worker) == (
        "r",
        "first",
        2,
        worker.id,
    )
    assert indices(stage.results()) == [14]
    assert failed.traceback[-1] == "ArithmeticError: thirteen"
    assert not caplog.records, "its learner shows the error"


def test_a_defect_of_the_farm_is_logged_once_with_its_traceback(
    stage: Stage, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As if no frame were outside the farm
    monkeypatch.setattr(plugins, "author_traceback", lambda _: ())
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.send(worker.id, 13, 14)
    assert stage.failure().traceback == ()
    learner.send(worker.id, 13)
    assert indices(stage.results()) == [14]
    stage.failure()
    [record] = caplog.records
    assert record.levelno == logging.ERROR
    assert record.exc_info
    assert record.message.startswith("a chunk of run r failed (ArithmeticError: thirteen)")


def test_a_refusal_is_told_of_once(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner, worker = Learner(stage.session, "r"), stage.hire()
    for _ in range(3):
        refusal = codec.encode(Refusal(run="r", reason="its machine\nrounds"))
        stage.session.publish(keys.refused(FARM, worker.id), refusal)
    # Each subscription has a thread of its own: jobs may overtake refusals
    until(lambda: caplog.messages)
    learner.send(worker.id, 0)
    stage.results()
    assert caplog.messages == ["run r does not take this worker: its machine rounds"]


# ---------------------------------------------------------------- classes in files


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return pole(tmp_path)


def test_a_class_in_an_allowed_file_is_served(real: Stage, file: Path, tmp_path: Path) -> None:
    learner = Learner(real.session, "r", spec_of(file))
    learner.header = replace(learner.header, mu=np.ones(2))
    worker = real.hire(allow_file=(pole(tmp_path / "elsewhere"),))
    learner.send(worker.id, 0, 1)
    returns = real.results().returns
    assert len(returns) == 2
    assert (returns > 3.9).all(), "four steps of at most 1"


def test_a_class_in_another_file_is_refused(real: Stage, file: Path) -> None:
    learner = Learner(real.session, "r", spec_of(file))
    worker = real.hire()
    learner.send(worker.id, 0)
    failure = real.failure()
    assert failure.index is None
    assert failure.error.startswith("pole.py is a file on the learner's machine: copy it here")


def test_the_end_of_a_run_is_told(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with connect((stage.endpoint,), WAIT, lambda: False) as presence:
        learner = Learner(stage.session, "r", presence=presence)
        worker = stage.hire()
        learner.announce()
        learner.send(worker.id, 0)
        stage.results()
        generations = learner.header.generation
    until(
        lambda: (
            f"run r: its learner left after {generations} generations; waiting for the next one"
            in caplog.messages
        )
    )


def test_settings_that_make_no_sense() -> None:
    for values, words in (
        ({"backend": "gpu"}, "unknown backend 'gpu'; known are cpu"),
        ({"allow_file": (Path("nowhere.py"),)}, "--allow-file nowhere.py: there is no such file"),
        ({"name": "a/b"}, "worker 'a/b' is not a name"),
        ({"farm": "*"}, r"farm '\*' is not a name"),
        ({"connect": ("tcp/here",)}, "is not of the form tcp/HOST:PORT"),
        ({"timeout": float("nan")}, "timeout is nan"),
    ):
        with pytest.raises(ConfigError, match=words):
            WorkerConfig(**values)  # type: ignore[arg-type]
    assert keys.checked("worker", WorkerConfig().name)


def test_a_worker_of_another_farm_hears_which_there_are(
    real: Stage, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(workers, "_LOOK", 0.0)
    learner = Learner(real.session, "r")
    learner.announce()
    with connect((real.endpoint,), WAIT, lambda: False) as session:
        worker = workers.Worker(
            WorkerConfig(connect=(real.endpoint,), farm="elsewhere", name="w"), session
        )
        worker.join()
        until(lambda: (worker.turn(), caplog.messages)[1])
    assert caplog.messages == [f"no learner on farm elsewhere; learners are on {FARM}: see --farm"]
