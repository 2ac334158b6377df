"""Which workers are connected, which take part, and which do not answer."""

import pytest
from doubles import request

from farm.errors import MessageError
from learner.pool import workforce as workforces
from learner.pool.admission import Admission
from learner.pool.workforce import END, LINE, Workforce

ANYBODY = Admission("c")
want = request


# ---------------------------------------------------------------- workforce


def test_a_worker_is_present_while_its_token_is() -> None:
    workforce = Workforce(ANYBODY)
    assert workforce.arrived("a/1") is None
    assert workforce.asked(want("a/1"), 0.0)
    workforce.left("a/1")
    assert not workforce.asked(want("a/1"), 0.0)


def test_a_question_ahead_of_its_token_is_heard_once_it_comes() -> None:
    workforce = Workforce(ANYBODY)
    assert not workforce.asked(want("a/1", 4), 0.0)
    assert not workforce.asked(want("a/1", 5), 1.0)
    assert workforce.arrived("a/1") == want("a/1", 5)
    assert workforce.arrived("a/1") is None
    assert workforce.absent(100.0) == []


def test_a_worker_that_never_comes_is_forgotten() -> None:
    workforce = Workforce(ANYBODY)
    workforce.asked(want("a/1"), 0.0)
    workforce.asked(want("b/1"), 2.0)
    workforce.asked(want("a/1"), 2.9)
    assert workforce.absent(3.0) == []
    assert workforce.absent(4.0) == ["a/1"]
    assert workforce.arrived("a/1") is None
    assert workforce.arrived("b/1") == want("b/1")


def test_early_requests_are_checked_in_turn() -> None:
    workforce = Workforce(ANYBODY)
    for name in ("a/1", "b/1", "c/1"):
        workforce.asked(want(name), 0.0)
    assert [workforce.without_token(2) for _ in range(3)] == [
        ["a/1", "b/1"],
        ["c/1", "a/1"],
        ["b/1", "c/1"],
    ]


def test_many_tokens_of_one_name_do_not_exclude_others(monkeypatch: pytest.MonkeyPatch) -> None:
    workforce = Workforce(ANYBODY, 2)
    for i in range(2):
        workforce.arrived(f"many/{i}")
    with pytest.raises(MessageError, match="of its name"):
        workforce.arrived("many/2")
    assert workforce.arrived("honest/1") is None
    workforce.left("many/0")
    workforce.arrived("many/2")


def test_names_and_tokens_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workforces, "_TOKENS", 2)
    monkeypatch.setattr(workforces, "_WAITING", 2)
    workforce = Workforce(ANYBODY)
    for name in ("a/1", "b/1"):
        workforce.arrived(name)
    with pytest.raises(MessageError, match="there are already 2 workers, or 500 of its name"):
        workforce.arrived("c/1")
    workforce.arrived("b/1")
    for name in ("d/1", "e/1"):
        workforce.asked(want(name), 0.0)
    with pytest.raises(MessageError, match="2 requests of workers"):
        workforce.asked(want("f/1"), 0.0)
    assert not workforce.asked(want("d/1", 9), 0.0)
    workforce.left("a/1")
    assert workforce.arrived("c/1") is None


# ---------------------------------------------------------------- who takes part


def test_rates_are_taken_over_the_last_ten_seconds() -> None:
    workforce = Workforce(Admission("c"))
    workforce.join(request("a/1"), 100.0)
    for second in range(101, 121):
        workforce.did("a/1", 30, float(second))
    (status,) = workforce.status(120.5)
    assert (status.worker, status.version, status.fingerprint, status.rollouts) == (
        "a/1",
        "0",
        "c",
        600,
    )
    assert status.rate == pytest.approx(30.0)
    assert status.seen == pytest.approx(0.5)
    (later,) = workforce.status(200.0)
    assert later.rate == 0.0


def test_a_new_worker_has_a_rate_at_once_and_one_that_left_has_none() -> None:
    workforce = Workforce(Admission("c"))
    workforce.join(request("b/1"), 0.0)
    workforce.did("b/1", 40, 2.0)
    workforce.did("stranger", 40, 2.0)
    assert [round(status.rate) for status in workforce.status(2.0)] == [20]
    workforce.left("b/1")
    workforce.left("b/1")
    assert workforce.status(3.0) == ()


def test_a_worker_that_cannot_serve_the_run_may_come_back_as_another() -> None:
    workforce = Workforce(Admission("c"))
    workforce.join(request("a/1"), 0.0)
    workforce.decline("a/1", "no mesh")
    assert (workforce.status(1.0), workforce.reasons) == ((), ["no mesh"])
    workforce.left("a/1")
    assert workforce.reasons == []


def test_a_worker_that_cannot_serve_the_run_is_not_tried_again_after_a_bad_request() -> None:
    workforce = Workforce(Admission("c"))
    workforce.arrived("a/1")
    workforce.join(request("a/1"), 0.0)
    workforce.decline("a/1", "no mesh")
    workforce.refuse("a/1", "a request of another release")
    assert workforce.is_declined("a/1")
    assert workforce.reasons == ["no mesh"]


def test_no_worker_of_an_expelled_host_takes_part() -> None:
    workforce = Workforce(Admission("c"))
    for worker in ("a/1", "a/2", "b/1"):
        workforce.join(request(worker), 0.0)
    assert workforce.expel("a", "it lies") == ["a/1", "a/2"]


# ---------------------------------------------------------------- who does not answer


def found(workforce: Workforce, now: float, patience: float = 1.0) -> list[tuple[str, int, bool]]:
    return [
        (worker, silence.job, over) for worker, silence, over in workforce.silent(now, patience)
    ]


def begun(*workers: str) -> Workforce:
    """Workers that have answered once, and have job 3 since 100 s."""
    workforce = Workforce(ANYBODY)
    for worker in workers:
        workforce.given(worker, 1, 0, 90.0)
        workforce.heard(worker, 95.0, waiting=False)
        workforce.given(worker, 3, 1, 100.0)
    return workforce


def test_a_line_and_then_the_end_each_once() -> None:
    workforce = begun("a")
    assert found(workforce, 100.0 + LINE - 0.1) == []
    assert found(workforce, 100.0 + LINE) == [("a", 3, False)]
    assert found(workforce, 100.0 + END - 0.1) == []
    assert found(workforce, 100.0 + END) == [("a", 3, True)]
    assert found(workforce, 1000.0) == []


def test_slow_tasks_are_given_time() -> None:
    workforce = begun("a")
    assert found(workforce, 100.0 + 299.0, patience=100.0) == []
    assert found(workforce, 100.0 + 300.0, patience=100.0) == [("a", 3, False)]
    assert found(workforce, 100.0 + 600.0, patience=100.0) == [("a", 3, True)]


def test_the_first_answer_may_take_longer() -> None:
    workforce = Workforce(ANYBODY)
    workforce.given("a", 0, 0, 0.0)
    assert found(workforce, 59.0) == []
    assert found(workforce, 60.0) == [("a", 0, False)]
    assert found(workforce, 299.0) == []
    assert found(workforce, 300.0) == [("a", 0, True)]


def test_who_answers_is_not_silent() -> None:
    workforce = begun("a", "b", "c")
    workforce.heard("a", 109.0, waiting=True)  # it has more
    workforce.heard("b", 109.0, waiting=False)
    workforce.left("c")
    assert found(workforce, 118.0) == []
    assert found(workforce, 119.0) == [("a", 3, False)]
    workforce.heard("a", 125.0, waiting=True)
    assert found(workforce, 134.0) == []
    assert found(workforce, 135.0) == [("a", 3, False)], "it is said again"


def test_silence_counts_from_the_oldest_job() -> None:
    workforce = begun("a")
    workforce.given("a", 7, 2, 109.0)
    assert found(workforce, 110.0) == [("a", 3, False)]


def test_rare_hangs_end_no_run() -> None:
    workforce = Workforce(ANYBODY)
    assert [workforce.replace(10) for _ in range(4)] == [False, False, False, True]
    workforce = Workforce(ANYBODY)
    assert not any(workforce.replace(rounds) for rounds in range(100, 5000, 100))
