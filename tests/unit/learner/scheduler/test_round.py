"""A round's results: whichever messages bring them, in whatever order, doubled or not, the same comes out."""

from dataclasses import replace

import numpy as np
import pytest

from farm.net.work import Job, Jobs
from farm.net.work import Result, Results, WireTrajectory
from learner.scheduler.round import RoundResults

TRACE = (3, 54)
SHAPES = {"bodies": (2, 7), "joints": (8,), "targets": (8,), "images": (3, 18), "points": (3, 3), "terms": (5,)}
PAIRS = 12
RETURNS = np.random.default_rng(0).integers(0, 4, (PAIRS, 2)).astype(float)  # many are equal
TRACES = np.random.default_rng(1).exponential(size=(PAIRS, 2, *TRACE)).astype("<f4")


def job(index: int) -> Job:
    seen = index == PAIRS
    return Job(
        index=index, origin="mu", signs=(1,) if seen else (1, -1), perturbation=None,
        rate="control" if seen else "none", eps=np.zeros(0 if seen else 2),
    )  # fmt: skip


def result(index: int) -> Result:
    seen = index == PAIRS
    no = np.zeros(1 if seen else 2, bool)
    arrays = {name: np.zeros((1, *shape), "<f4") for name, shape in SHAPES.items()}
    return Result(
        index=index, trajectory=WireTrajectory(value=9.0, success=True, times=np.zeros(1), **arrays) if seen else None,
        returns=np.full(1, 9.0) if seen else RETURNS[index], success=no, dropped=no,
        failed=no, clamped=no, traces=np.zeros((1, *TRACE), "<f4") if seen else TRACES[index],
    )  # fmt: skip


def begun(traces: str) -> RoundResults:
    return RoundResults(Jobs.of([job(i) for i in range(PAIRS + 1)]), traces, TRACE, SHAPES)


def message(indices: list[int], traces: str) -> Results:
    return Results.of([result(i) for i in indices], run="r", incarnation="i", round=1, worker="w/1", traces=traces)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("traces", ["extremes", "all"])
def test_the_traces_that_are_wanted_come_whichever_jobs_travel_together(traces: str, seed: int) -> None:
    rng, done, round_ = np.random.default_rng(seed), set[int](), begun(traces)
    while len(done) <= PAIRS:
        some = rng.permutation(PAIRS + 1)[: rng.integers(1, 6)].tolist()
        sent = message(some, traces)
        place = round_.place(sent)
        assert place is not None
        round_.put(sent, place, np.array([index not in done for index in sent.jobs.tolist()]))
        done.update(some)
    assert round_.returns.tolist() == [*RETURNS.reshape(-1), 9.0]
    flat, kept = TRACES.reshape(-1, *TRACE), round_.traces
    chosen = {int(RETURNS.argmax()), int(RETURNS.argmin())} if traces == "extremes" else set(range(2 * PAIRS))
    assert chosen <= set(kept)
    assert all(kept[row].tobytes() == flat[row].tobytes() for row in kept)
    assert round_[PAIRS].trajectory is not None


@pytest.mark.parametrize(("wanted", "sent"), [("extremes", "none"), ("extremes", "all"), ("none", "extremes")])
def test_other_traces_than_were_wanted_do_not_fit(wanted: str, sent: str) -> None:
    assert begun(wanted).place(message([0, 3, PAIRS], sent)) is None


def test_traces_of_another_length_do_not_fit() -> None:
    longer = RoundResults(begun("all").jobs, "all", (4, 54), SHAPES)
    assert longer.place(message([0], "all")) is None
    assert longer.place(message([PAIRS], "all")) is not None  # it has none


def test_a_message_with_a_job_of_no_round_does_not_fit() -> None:
    """Its best rollout may be that job's, and a trace that is needed be missing."""
    good = message([0, 3], "extremes")
    for index in (-1, PAIRS + 1):
        assert begun("extremes").place(replace(good, jobs=np.sort(np.array([0, index])))) is None
    assert begun("extremes").place(replace(good, jobs=np.array([0, PAIRS]))) is None  # that one is of one rollout


def test_results_of_other_shapes_do_not_fit() -> None:
    good, round_ = message([0, 3, PAIRS], "extremes"), begun("extremes")
    place = round_.place(good)
    assert place is not None
    assert place.rows.tolist() == [0, 1, 6, 7, 2 * PAIRS]
    assert place.shown.tolist() == [PAIRS]
    assert round_.place(replace(good, trajectories=())) is None
    assert round_.place(replace(good, trajectories=good.trajectories * 2)) is None
    assert round_.place(replace(good, returns=good.returns[1:], flags=good.flags[1:])) is None
    assert round_.place(replace(good, traces=good.traces[1:])) is None
    assert round_.place(replace(good, traces=good.traces[:, 1:])) is None
    wide = replace(good.trajectories[0], bodies=np.zeros((1, 3, 7), "<f4"))
    assert round_.place(replace(good, trajectories=(wide,))) is None
