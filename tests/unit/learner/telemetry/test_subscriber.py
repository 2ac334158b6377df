"""Following a run: real sessions on loopback, with a learner that loses and repeats messages and
restarts.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from made import stats

from farm.errors import ConfigError, Interrupted, RunError
from farm.net import codec, keys, session
from farm.net.session import Session, free_endpoint
from farm.net.telemetry import Report, RunEnd, RunHistory
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.states import RolledBack
from learner.telemetry import subscriber as subscribers
from learner.telemetry.report_log import ReportLog
from learner.telemetry.subscriber import Subscriber, check_allowed, find_run


class LearnerSide:
    """A learner's side: what it published, and what it answers."""

    def __init__(self, link: Session) -> None:
        self.link, self.history = link, ReportLog(page=3000)
        self.page = RunHistory(
            run="r",
            incarnation="one",
            recording="r",
            config=configs.to_dict(RunConfig()),
            files={"model.xml": "<mujoco/>"},
            generation=0,
            reports=(),
            end=None,
        )
        self.asked: list[int] = []
        self.after: Callable[[], None] = lambda: None
        """Done once, behind the next answer."""
        link.answer_asked(keys.history("farm", "r"), self._answer)

    def _answer(self, query: str) -> bytes:
        first = int(query.removeprefix("from="))
        self.asked.append(first)
        reply = codec.encode(replace(self.page, reports=self.history.page(first)))
        after, self.after = self.after, lambda: None
        after()
        return reply

    def report(self, generation: int, *, silent: bool = False) -> None:
        report = Report(incarnation=self.page.incarnation, progress=stats(generation), rate=1.0)
        self.history.add(report)
        self.page = replace(self.page, generation=generation)
        if not silent:
            self.again(report)

    def again(self, report: Report) -> None:
        self.link.publish(keys.report("farm", "r"), codec.encode(report))

    def end(self) -> None:
        self.page = replace(
            self.page, end=RunEnd(summary={}, lines=(), best=None, best_generation=0, mean=None)
        )
        self.link.publish(keys.history("farm", "r"), b"")


@pytest.fixture
def pair() -> Iterator[tuple[LearnerSide, Subscriber]]:
    endpoint = free_endpoint()
    with (
        session.listen(endpoint, "farm") as link,
        session.connect((endpoint,), 10, lambda: False) as other,
    ):
        learner = LearnerSide(link)
        follower = Subscriber(other, "farm", "r")
        assert follower.begin(lambda: False) == ("r", RunConfig(), {"model.xml": "<mujoco/>"})
        yield learner, follower


def take(reports: Iterator[Report | RunEnd], count: int) -> list[int]:
    return [
        message.generation
        for _, message in zip(range(count), reports, strict=False)
        if isinstance(message, Report)
    ]


def test_in_order_and_each_once(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    for generation in range(1, 11):
        learner.report(generation, silent=generation <= 6)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 10) == list(range(1, 11))
    queries = len(learner.asked)
    learner.report(11)
    learner.again(learner.history.page(11)[0])
    learner.report(12)
    assert take(reports, 2) == [11, 12]
    assert len(learner.asked) <= queries + 1, "what comes as it should is not asked for"
    learner.report(13, silent=True)
    learner.report(14)
    assert take(reports, 2) == [13, 14]
    learner.report(15, silent=True)
    learner.end()
    assert take(reports, 1) == [15]
    assert isinstance(next(reports), RunEnd)
    assert next(reports, None) is None


def test_from_where_a_file_ends(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    for generation in range(1, 6):
        learner.report(generation, silent=True)
    assert take(follower.follow(3, lambda: False), 2) == [4, 5]


def test_the_last_report_is_lost_and_nothing_follows(
    pair: tuple[LearnerSide, Subscriber], monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, follower = pair
    monkeypatch.setattr(subscribers, "_QUIET", 0.1)
    learner.report(1)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 1) == [1]
    # Just when the follower has heard that there is none
    learner.after = lambda: learner.report(2, silent=True)
    assert take(reports, 1) == [2]
    assert learner.asked[-2:] == [2, 2]


def test_generations_rolled_back_are_not_told_twice(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    for generation in range(1, 6):
        learner.report(generation)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 5) == [1, 2, 3, 4, 5]
    learner.page = replace(learner.page, incarnation="two", generation=3)
    learner.history = ReportLog()
    for generation in range(1, 4):
        learner.history.add(Report(incarnation="two", progress=stats(generation), rate=1.0))
    for generation in (4, 5, 6, 7):
        learner.report(generation)
    assert take(reports, 2) == [6, 7]


def test_what_a_folder_lost_is_not_waited_for(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    learner.page = replace(learner.page, generation=4)
    learner.report(5, silent=True)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 1) == [5]
    learner.page = replace(learner.page, generation=9)
    learner.end()
    assert isinstance(next(reports), RunEnd)


def test_another_run_of_the_same_name(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    learner.report(1)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 1) == [1]
    config = configs.to_dict(RunConfig(seed=5))
    learner.page = replace(learner.page, incarnation="two", generation=0, config=config)
    learner.history = ReportLog()
    learner.report(1)
    with pytest.raises(RunError, match="run r was started again with --seed 5 instead of 0"):
        next(reports)


def test_a_learner_of_another_version(
    pair: tuple[LearnerSide, Subscriber], monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, follower = pair
    monkeypatch.setattr(learner, "page", replace(learner.page, generation="many"))
    with pytest.raises(
        RunError, match="the learner of run r cannot be understood: RunHistory.generation"
    ):
        next(follower.follow(0, lambda: False))


def test_stopped(pair: tuple[LearnerSide, Subscriber]) -> None:
    _, follower = pair
    assert list(follower.follow(0, lambda: True)) == []


def test_stopped_before_anybody_is_there(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    with pytest.raises(Interrupted, match="stopped before run r was there"):
        follower.begin(lambda: True)
    with pytest.raises(Interrupted):
        find_run(learner.link, "farm", lambda: True)


def test_the_only_run_of_a_farm_is_found(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    learner.link.token(keys.learner_token("farm", "r"))
    assert find_run(learner.link, "farm", lambda: False) == "r"
    learner.link.token(keys.learner_token("farm", "s"))
    with pytest.raises(
        ConfigError, match="^this farm has several runs: r, s; choose one with --run"
    ):
        find_run(learner.link, "farm", lambda: False)


def test_classes_in_files_are_those_of_this_machine(tmp_path: Path) -> None:
    config = configs.to_dict(RunConfig())
    assert configs.localised(config, ()) == config
    check_allowed(config, ())
    config["task"]["name"] = "/somewhere/else/pole.py:Pole"
    here = tmp_path / "pole.py"
    check_allowed(config, (tmp_path / "other.py", here))
    local = configs.localised(config, (tmp_path / "other.py", here))
    assert local["task"] == {**config["task"], "name": f"{here}:Pole"}
    assert config["task"]["name"].startswith("/somewhere"), "the configuration is left alone"
    with pytest.raises(
        ConfigError,
        match=r"the run's task is a class in pole\.py: copy it here, and give --allow-file",
    ):
        check_allowed(config, (tmp_path / "other.py",))


def test_a_run_that_went_back_is_another_recording(pair: tuple[LearnerSide, Subscriber]) -> None:
    learner, follower = pair
    for generation in range(1, 7):
        learner.report(generation)
    reports = follower.follow(0, lambda: False)
    assert take(reports, 6) == list(range(1, 7))
    learner.history = ReportLog()
    learner.page = replace(
        learner.page, incarnation="two", recording="r-undone4", generation=2, undone=4
    )
    for generation in range(3, 9):  # more than are recorded
        learner.report(generation)
    with pytest.raises(RolledBack, match="run r went back to generation .: a host was expelled"):
        next(reports)
    assert follower.begin(lambda: False)[0] == "r-undone4"
    assert follower.undone == 4
