"""The round under way: what is due, what counts, and what two hosts must agree on."""

from dataclasses import replace

import numpy as np
from doubles import PATIENT, jobs

from farm.net.work import Results
from learner.scheduler.ledger import Ledger
from learner.scheduler.round import RoundResults, Shapes
from learner.scheduler.scheduler import SchedulerConfig

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
    ledger = Ledger(config, None, np.random.default_rng(0))
    assert not ledger.over
    for worker in workers:
        ledger.scheduler.want(worker, 2, 0.0)
    ledger.begin(RoundResults(jobs(count), "none", Shapes(trace=(3, 4), frame={})))
    return ledger


def by_worker(ledger: Ledger, now: float) -> dict[str, list[int]]:
    out: dict[str, list[int]] = {}
    for worker, indices in ledger.due(now):
        out.setdefault(worker, []).extend(indices)
    return out


def test_a_round_is_over_when_every_job_is_done() -> None:
    ledger = ledger_of(2, "a/1")
    assert by_worker(ledger, 0.0) == {"a/1": [0, 1]}
    assert ledger.put(results("a/1", 0), 1.0) == (["new"], {})
    assert not ledger.over
    assert ledger.put(results("a/1", 0, 1, value=2.0), 2.0) == (["doubled", "new"], {})
    assert ledger.over
    assert ledger.due(3.0) == []
    assert ledger.round.returns.tolist() == [1.0, 1.0, 2.0, 2.0]


def test_results_that_do_not_fit_have_no_verdict() -> None:
    ledger = ledger_of(1, "a/1")
    ledger.due(0.0)
    assert ledger.put(results("a/1", 5), 1.0) == ([], {})
    assert ledger.put(results("b/1", 0), 1.0) == (["unasked"], {})


def test_jobs_of_a_worker_that_left_are_due_again() -> None:
    ledger = ledger_of(2, "a/1")
    ledger.due(0.0)
    assert ledger.lost("a/1") == 2
    ledger.scheduler.want("b/1", 2, 1.0)
    assert by_worker(ledger, 1.0) == {"b/1": [0, 1]}


def test_a_host_with_other_numbers_than_two_others_is_named_and_its_jobs_are_repeated() -> None:
    ledger = ledger_of(2, "a/1", "b/1", "c/1", config=AUDITED)
    value = {"a/1": 9.0, "b/1": 1.0, "c/1": 1.0}
    wrong: dict[str, int] = {}
    for now in range(20):
        for worker, indices in by_worker(ledger, float(now)).items():
            for index in indices:
                _, liars = ledger.put(results(worker, index, value=value[worker]), now + 0.5)
                wrong |= liars
        if wrong:
            break
    assert wrong.keys() == {"a"}
    ledger.lost("a/1")
    assert ledger.expel("a") > 0
    for now in range(20, 40):
        for worker, indices in by_worker(ledger, float(now)).items():
            for index in indices:
                ledger.put(results(worker, index, value=value[worker]), now + 0.5)
    assert ledger.over
    assert set(ledger.round.returns.tolist()) == {1.0}
