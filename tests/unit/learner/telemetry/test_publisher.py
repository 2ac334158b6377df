"""What a learner publishes for viewers: every report, its log, pages of the past, the end."""

import logging
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made import stats

from farm.net import codec, keys, session
from farm.net.session import Session, free_endpoint
from farm.net.telemetry import Report, RunEnd, RunHistory
from farm.sim.trajectory import Trajectory
from learner.run.config import RunConfig
from learner.telemetry import publisher as publishers
from learner.telemetry.publisher import LINE, LINES, Publisher

SHOWN = Trajectory.of(
    times=np.zeros(1),
    bodies=np.zeros((1, 2, 7)),
    actions=np.zeros((1, 1)),
    terms=np.zeros((1, 1)),
    channels={"angle": np.ones((1, 1))},
    value=0.5,
    success=None,
)


def report(generation: int, **changed: Any) -> Report:
    traces = {"best": np.ones((3, 2), "<f4"), "all": np.ones((4, 3, 2), "<f4")}
    values = {
        "rate": 5.0,
        "sample": SHOWN,
        "traces": traces,
        "replay": None,
        "replay_generation": 0,
    }
    return Report(progress=stats(generation), **(values | changed))


def test_a_report_there_and_back() -> None:
    original = report(3, replay=SHOWN, replay_generation=2)
    back = codec.decode(codec.encode(original), Report)
    assert (back.progress, back.rate, back.replay_generation) == (original.progress, 5.0, 2)
    assert {name: values.shape for name, values in back.traces.items()} == {
        "best": (3, 2),
        "all": (4, 3, 2),
    }
    assert back.sample is not None
    assert back.sample.channels["angle"].tolist() == [[1.0]]


@pytest.fixture
def link() -> Iterator[tuple[Session, Session]]:
    endpoint = free_endpoint()
    with (
        session.listen(endpoint, "farm") as listener,
        session.connect((endpoint,), 10, lambda: False) as other,
    ):
        yield listener, other


@pytest.fixture
def publisher(link: tuple[Session, Session]) -> Iterator[Publisher]:
    """The publisher of a run that has done two generations, in a folder that was then renamed."""
    folder = SimpleNamespace(name="r", progress_after=lambda _: iter([stats(1), stats(2)]))
    learner = SimpleNamespace(
        folder=folder,
        run="first",
        config=RunConfig(),
        state=SimpleNamespace(generation=2),
        undone=0,
        problem=SimpleNamespace(task=SimpleNamespace(sources={"model.xml": "<mujoco/>"})),
    )
    service = Publisher(link[0], "farm", "i", learner)  # type: ignore[arg-type]
    yield service
    service.close()


def page(other: Session, first: object) -> RunHistory:
    payload = other.ask(f"{keys.history('farm', 'r')}?from={first}", 10.0)
    assert payload is not None
    return codec.decode(payload, RunHistory)


def test_a_late_subscriber_receives_everything(
    publisher: Publisher, link: tuple[Session, Session]
) -> None:
    publisher.generation(report(3))
    history = page(link[1], 1)
    assert (history.run, history.recording, history.generation, history.files) == (
        "r",
        "first",
        3,
        {"model.xml": "<mujoco/>"},
    )
    assert [one.generation for one in history.reports] == [1, 2, 3]
    assert [one.rate for one in history.reports] == [15.0, 15.0, 5.0]
    assert [one.sample is None for one in history.reports] == [True, True, False]
    assert [one.generation for one in page(link[1], 3).reports] == [3]
    for nonsense in ("-1", "many", "", "9" * 50):
        assert page(link[1], nonsense).generation == 3
    publisher.end(RunEnd(summary={"state": "finished"}, best=None, best_generation=0, mean=None))
    end = page(link[1], 4).end
    assert end is not None
    assert (end.summary, end.best, end.mean) == ({"state": "finished"}, None, None)


def test_lines_of_the_log_travel_with_the_next_report(
    publisher: Publisher, link: tuple[Session, Session]
) -> None:
    log = logging.getLogger("learner.made_up")
    for number in range(LINES + 5):
        log.warning("%d %s", number, "x" * LINE)
    publisher.generation(report(3))
    publisher.generation(report(4))
    third, fourth = page(link[1], 3).reports
    assert len(third.lines) == LINES
    assert third.lines[0].text.startswith("5 xxx")
    assert {len(line.text) for line in third.lines} == {LINE}
    assert fourth.lines == ()


def test_traces_that_are_too_large_stay_behind(
    publisher: Publisher, link: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publishers, "_TRACES", 50)
    publisher.generation(report(3))
    [last] = page(link[1], 3).reports
    assert list(last.traces) == ["best"]
