"""The round under way: what is due, what counts, and what is checked."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from doubles import HEADER, PATIENT, jobs, secret

from farm.net.work import Results
from learner.pool.audit import Check, Source
from learner.pool.ledger import Ledger
from learner.pool.round import RoundResults, Shapes
from learner.pool.scheduler import SchedulerConfig

AUDITED = replace(PATIENT, audit=1.0)


def results(worker: str, *indices: int, value: float = 1.0) -> Results:
    count = 2 * len(indices)
    return Results(
        run="r",
        incarnation="i",
        round=1,
        worker=worker,
        jobs=np.array(indices),
        returns=np.full(count, value),
        flags=np.zeros((count, 4), bool),
        steps=np.ones(count, "<i8"),
        traces=np.zeros((0, 3, 4), "<f4"),
        trajectories=(),
    )


def ledger_of(count: int, *workers: str, config: SchedulerConfig = PATIENT) -> Ledger:
    """A round of pairs, and workers that each take two jobs."""
    ledger = Ledger(
        config, lambda name: Source(name[0], "bits") if name[0] != "z" else None, secret()
    )
    assert not ledger.over
    for worker in workers:
        ledger.scheduler.want(worker, 2, 0.0)
    ledger.begin(HEADER, RoundResults(jobs(count), "none", Shapes(trace=(3, 4), frame={})))
    return ledger


def by_worker(ledger: Ledger, now: float) -> dict[str, list[int]]:
    out: dict[str, list[int]] = {}
    for worker, indices in ledger.due(now):
        out.setdefault(worker, []).extend(indices)
    return out


def test_a_round_is_over_when_every_job_is_done() -> None:
    ledger = ledger_of(2, "a/1")
    assert by_worker(ledger, 0.0) == {"a/1": [0, 1]}
    assert ledger.put(results("a/1", 0), 1.0) == ["new"]
    assert not ledger.over
    assert ledger.put(results("a/1", 0, 1, value=2.0), 2.0) == ["doubled", "new"]
    assert ledger.over
    assert ledger.due(3.0) == []
    assert ledger.round.returns.tolist() == [1.0, 1.0, 2.0, 2.0]


def test_results_that_do_not_fit_have_no_verdict() -> None:
    ledger = ledger_of(1, "a/1")
    ledger.due(0.0)
    assert ledger.put(results("a/1", 5), 1.0) == []
    assert ledger.put(results("b/1", 0), 1.0) == ["unasked"]


def test_jobs_of_a_worker_that_left_are_due_again() -> None:
    ledger = ledger_of(2, "a/1")
    ledger.due(0.0)
    assert ledger.lost("a/1") == 2
    ledger.scheduler.want("b/1", 2, 1.0)
    assert by_worker(ledger, 1.0) == {"b/1": [0, 1]}


def indices(checks: Sequence[Check]) -> list[tuple[str, int]]:
    return sorted((each.source.host, int(each.job.indices[0])) for each in checks)


def test_jobs_of_a_host_that_is_wrong_are_due_again() -> None:
    ledger = ledger_of(2, "a/1", config=AUDITED)
    ledger.due(0.0)
    ledger.put(results("a/1", 0, 1, value=9.0), 1.0)
    assert ledger.over
    check = ledger.audit.take(1)[0]
    assert ledger.audit.found(check, "wrong") == "a"
    ledger.lost("a/1")
    assert ledger.expel("a") == 2
    assert ledger.audit.settled, "nothing of it is checked any more"
    assert not ledger.over
    ledger.scheduler.want("b/1", 2, 2.0)
    assert by_worker(ledger, 2.0) == {"b/1": [0, 1]}
    ledger.put(results("b/1", 0, 1), 3.0)
    assert ledger.over
    assert ledger.round.returns.tolist() == [1.0] * 4


def test_what_the_learners_own_workers_answer_is_not_checked() -> None:
    ledger = ledger_of(2, "z/1", config=AUDITED)
    ledger.due(0.0)
    ledger.put(results("z/1", 0, 1), 1.0)
    assert ledger.over
    assert ledger.audit.settled
    assert ledger.audit.hosts == []


def test_both_answers_to_a_job_are_checked_if_they_differ() -> None:
    sometimes = replace(PATIENT, audit=1e-9, straggler_seconds=0.1)
    for value, differing in ((1.0, []), (2.0, [("a", 0), ("b", 0)])):
        ledger = ledger_of(2, "a/1", config=sometimes)
        ledger.due(0.0)
        ledger.scheduler.want("b/1", 2, 9.0)
        assert 0 in by_worker(ledger, 9.0)["b/1"], "a copy, as the first one is late"
        ledger.put(results("a/1", 0), 10.0)
        assert ledger.put(results("b/1", 0, value=value), 11.0) == ["doubled"]
        assert indices(ledger.audit.take(9)) == differing
