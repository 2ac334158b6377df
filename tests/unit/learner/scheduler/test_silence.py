"""Workers that do not answer: when a line says so, and when their process is ended."""

from learner.scheduler.silence import END, LINE, Silences


def found(silences: Silences, now: float, patience: float = 1.0) -> list[tuple[str, int, bool]]:
    return [(worker, silence.job, over) for worker, silence, over in silences.long(now, patience)]


def begun(*workers: str) -> Silences:
    """Workers that have answered once, and have job 3 since 100 s."""
    silences = Silences()
    for worker in workers:
        silences.given(worker, 1, 0, 90.0)
        silences.heard(worker, 95.0, waiting=False)
        silences.given(worker, 3, 1, 100.0)
    return silences


def test_a_line_and_then_the_end_each_once() -> None:
    silences = begun("a")
    assert found(silences, 100.0 + LINE - 0.1) == []
    assert found(silences, 100.0 + LINE) == [("a", 3, False)]
    assert found(silences, 100.0 + END - 0.1) == []
    assert found(silences, 100.0 + END) == [("a", 3, True)]
    assert found(silences, 1000.0) == []


def test_slow_tasks_are_given_time() -> None:
    silences = begun("a")
    assert found(silences, 100.0 + 299.0, patience=100.0) == []
    assert found(silences, 100.0 + 300.0, patience=100.0) == [("a", 3, False)]
    assert found(silences, 100.0 + 600.0, patience=100.0) == [("a", 3, True)]


def test_the_first_answer_may_take_longer() -> None:
    silences = Silences()
    silences.given("a", 0, 0, 0.0)
    assert found(silences, 59.0) == []
    assert found(silences, 60.0) == [("a", 0, False)]
    assert found(silences, 299.0) == []
    assert found(silences, 300.0) == [("a", 0, True)]


def test_who_answers_is_not_silent() -> None:
    silences = begun("a", "b", "c")
    silences.heard("a", 109.0, waiting=True)  # it has more
    silences.heard("b", 109.0, waiting=False)
    silences.left("c")
    assert found(silences, 118.0) == []
    assert found(silences, 119.0) == [("a", 3, False)]
    silences.heard("a", 125.0, waiting=True)
    assert found(silences, 134.0) == []
    assert found(silences, 135.0) == [("a", 3, False)], "it is said again"


def test_silence_counts_from_the_oldest_job() -> None:
    silences = begun("a")
    silences.given("a", 7, 2, 109.0)
    assert found(silences, 110.0) == [("a", 3, False)]


def test_rare_hangs_end_no_run() -> None:
    silences = Silences()
    assert [silences.end(10) for _ in range(4)] == [False, False, False, True]
    silences = Silences()
    assert not any(silences.end(rounds) for rounds in range(100, 5000, 100))
