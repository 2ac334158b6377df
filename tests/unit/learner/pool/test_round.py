"""A round's results do not depend on how messages group, order or repeat them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from farm.net import codec
from farm.net.work import Jobs, Results, rows_with_trace
from farm.sim.trajectory import Trajectory
from learner.pool.round import RoundResults, Shapes

TRACE = (3, 5)
FRAME = {"bodies": (2, 7), "actions": (1,), "terms": (2,), "channels/angle": (1,)}
PAIRS = 12
LAST = PAIRS + 1
RETURNS = np.random.default_rng(0).integers(0, 4, 2 * PAIRS).astype(float)  # many are equal
TRACES = np.random.default_rng(1).exponential(size=(2 * PAIRS, *TRACE)).astype("<f4")
SHOWN = Trajectory(
    value=9.0,
    success=True,
    times=np.zeros(1),
    bodies=np.zeros((1, 2, 7), "<f4"),
    actions=np.zeros((1, 1), "<f4"),
    terms=np.zeros((1, 2), "<f4"),
    channels={"angle": np.zeros((1, 1), "<f4")},
)
JOBS = Jobs.joined(
    [
        Jobs.exploring(np.zeros((PAIRS, 2)), (1, -1), None),
        Jobs.mean("control", [None]),
        Jobs.single(np.zeros(2), "physics", None),
    ]
)


def round_of(traces: str, trace: tuple[int, int] = TRACE) -> RoundResults:
    return RoundResults(JOBS, traces, Shapes(trace=trace, frame=FRAME))


def message(indices: Sequence[int], traces: str) -> Results:
    """A worker's message with the results of these jobs."""
    jobs = sorted(indices)
    rows = [row for job in jobs for row in ((2 * job, 2 * job + 1) if job < PAIRS else (-1,))]
    returns = np.array([9.0 if row < 0 else RETURNS[row] for row in rows])
    picks = [rows[at] for at in rows_with_trace(traces, returns, np.array(rows) >= 0)]
    return Results(
        run="r",
        incarnation="i",
        round=1,
        worker="w/1",
        jobs=np.array(jobs),
        returns=returns,
        flags=np.array([[row % 2 == 1, False, row < 0, False] for row in rows]),
        steps=np.array([1 + row % 2 for row in rows]),
        traces=TRACES[picks],
        trajectories=tuple(replace(SHOWN, value=float(job)) for job in jobs if job >= PAIRS),
    )


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("traces", ["extremes", "all"])
def test_the_traces_that_are_wanted_come_whichever_jobs_travel_together(
    traces: str, seed: int
) -> None:
    rng, done, round_ = np.random.default_rng(seed), set[int](), round_of(traces)
    while len(done) <= LAST:
        batch = rng.permutation(LAST + 1)[: rng.integers(1, 6)].tolist()
        answer = message(batch, traces)
        place = round_.place(answer)
        assert place is not None
        if done & set(batch):  # what came before stays, whatever this message says
            returns = np.where(np.isin(place.rows, list(_rows(done, round_))), -7.0, answer.returns)
            trajectories = tuple(
                replace(t, value=-7.0) if int(t.value) in done else t for t in answer.trajectories
            )
            answer = replace(answer, returns=returns, trajectories=trajectories)
        round_.put(answer, place, np.array([index not in done for index in answer.jobs.tolist()]))
        done.update(batch)
    assert round_.returns.tolist() == [*RETURNS, 9.0, 9.0]
    assert round_.flags[:, 0].tolist() == [False, True] * PAIRS + [True, True]
    arrays = round_.traces
    extremes = (
        {int(RETURNS.argmax()), int(RETURNS.argmin())}
        if traces == "extremes"
        else set(range(2 * PAIRS))
    )
    assert extremes <= set(arrays)
    assert all(arrays[row].tobytes() == TRACES[row].tobytes() for row in arrays)
    trajectories = [round_.trajectory(job) for job in (0, PAIRS, LAST)]
    assert [None if one is None else one.value for one in trajectories] == [None, PAIRS, LAST]


def _rows(jobs: set[int], round_: RoundResults) -> set[int]:
    return {row for job in jobs for row in range(round_.rows(job).start, round_.rows(job).stop)}


def test_rows_of_a_job() -> None:
    round_ = round_of("none")
    assert [round_.rows(job) for job in (0, 3, PAIRS, LAST)] == [
        slice(0, 2),
        slice(6, 8),
        slice(24, 25),
        slice(25, 26),
    ]
    assert len(round_) == LAST + 1


@pytest.mark.parametrize(
    ("traces", "others"), [("extremes", "none"), ("extremes", "all"), ("none", "extremes")]
)
def test_other_traces_than_were_wanted_do_not_fit(traces: str, others: str) -> None:
    assert round_of(traces).place(message([0, 3, PAIRS], others)) is None


def test_traces_of_another_length_do_not_fit() -> None:
    longer = round_of("all", (4, 5))
    assert longer.place(message([0], "all")) is None
    assert longer.place(message([PAIRS], "all")) is not None  # it has none


def test_a_message_with_a_job_of_no_round_does_not_fit() -> None:
    """Its best rollout may be that job's, and a trace that is needed be missing."""
    good = message([0, 3], "extremes")
    for index in (-1, LAST + 1, 2**62):
        assert round_of("extremes").place(replace(good, jobs=np.sort(np.array([0, index])))) is None
    # That one is of one rollout
    assert round_of("extremes").place(replace(good, jobs=np.array([0, PAIRS]))) is None


def test_results_of_other_shapes_do_not_fit() -> None:
    good, round_ = message([0, 3, PAIRS], "extremes"), round_of("extremes")
    place = round_.place(good)
    assert place is not None
    assert place.rows.tolist() == [0, 1, 6, 7, 2 * PAIRS]
    assert place.shown.tolist() == [PAIRS]
    [trajectory] = good.trajectories
    wide = replace(trajectory, bodies=np.zeros((1, 3, 7), "<f4"))
    other = replace(trajectory, channels={})
    for change in (
        {"trajectories": ()},
        {"trajectories": good.trajectories * 2},
        {"trajectories": (wide,)},
        {"trajectories": (other,)},
        {"returns": good.returns[1:], "flags": good.flags[1:], "steps": good.steps[1:]},
        {"steps": good.steps * 0},
        {"steps": good.steps + TRACE[0]},
        {"traces": good.traces[1:]},
        {"traces": good.traces[:, 1:]},
    ):
        assert round_.place(replace(good, **change)) is None, change


def test_moments_are_written_where_they_belong_and_fit_or_not() -> None:
    round_ = RoundResults(
        JOBS, "none", Shapes(trace=TRACE, frame=FRAME, observation=2), observed=True
    )
    assert round_.place(message([0], "none")) is None, "it has none"
    for job in (1, 0, PAIRS):
        answer = message([job], "none")
        answer = replace(answer, moments=np.full((len(answer.returns), 5), job + 1.0))
        for wrong in (np.zeros((len(answer.returns), 3)), np.zeros((0, 0))):
            assert round_.place(replace(answer, moments=wrong)) is None
        place = round_.place(answer)
        assert place is not None
        round_.put(answer, place, np.ones(1, bool))
    assert round_.moments[:4, 0].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert round_.moments[round_.rows(PAIRS), 0].tolist() == [PAIRS + 1.0]
    plain = RoundResults(JOBS, "none", Shapes(trace=TRACE, frame=FRAME))
    answer = message([0], "none")
    assert plain.place(answer) is not None
    assert plain.place(replace(answer, moments=np.zeros((2, 5)))) is None, (
        "moments were not requested"
    )


@pytest.mark.parametrize("changed", ["returns", "flags", "steps", "moments"])
def test_answers_differ_by_any_number_that_counts(changed: str) -> None:
    round_ = RoundResults(
        JOBS, "none", Shapes(trace=TRACE, frame=FRAME, observation=2), observed=True
    )
    answer = message([0, 1], "none")
    answer = replace(answer, moments=np.ones((4, 5)))
    place = round_.place(answer)
    assert place is not None
    round_.put(answer, place, np.ones(2, bool))
    assert round_.answer(1) == round_.given(answer, 1)
    other = getattr(answer, changed).copy()
    other[-1:] = other[-1:] ^ True if changed == "flags" else other[-1:] + 1
    lie = replace(answer, **{changed: other})
    assert round_.answer(0) == round_.given(lie, 0)
    assert round_.answer(1) != round_.given(lie, 1)


def test_measures_and_terms_belong_to_results_that_were_asked_for_them() -> None:
    round_ = RoundResults(JOBS, "none", Shapes(trace=TRACE, frame=FRAME, measures=3), terms=True)
    plain = message([0, LAST], "none")
    assert round_.place(plain) is None
    answer = replace(plain, measures=np.arange(9.0).reshape(3, 3), terms=np.ones((3, 2)))
    place = round_.place(answer)
    assert place is not None
    round_.put(answer, place, np.array([True, True]))
    assert round_.measures[[0, 1, -1]].tolist() == answer.measures.tolist()
    assert round_.answer(0) == round_.given(answer, 0)
    other = replace(answer, measures=answer.measures + 1e-9)
    assert round_.answer(0) != round_.given(other, 0), "a spot check compares them"
    for wrong in (
        {"measures": np.zeros((3, 2))},
        {"terms": np.zeros((3, 3))},
        {"measures": np.empty((0, 0))},
    ):
        assert round_.place(replace(answer, **wrong)) is None
    assert round_of("none").place(answer) is None, "nobody asked for them"


def test_jobs_are_cut_into_messages_whose_answers_are_not_too_large() -> None:
    shapes = Shapes(trace=(1000, 100), frame=FRAME, substeps=10)
    trace, pair = 4 * 1000 * 100, Jobs.exploring(np.zeros((100, 3)), (1, -1), None)
    all_traces = [list(batch) for batch in RoundResults(pair, "all", shapes).messages(range(100))]
    assert sum(all_traces, []) == list(range(100))
    assert {len(batch) for batch in all_traces[:-1]} <= {10, 11}, "8 MiB / 800 kB"
    assert [
        list(batch) for batch in RoundResults(pair, "extremes", shapes).messages([3, 4, 9])
    ] == [[3, 4, 9]]
    physics = RoundResults(Jobs.mean("physics", [None] * 100), "none", shapes)
    assert len(list(physics.messages(range(100)))) == 10, "10 001 frames of 80 bytes each"
    assert shapes.largest_message == (9 << 20) + 2 * (2 * (trace + 44) + 10_001 * 80)
    large = RoundResults(Jobs.exploring(np.zeros((6, 1_000_000)), (1,), None), "none", shapes)
    assert [len(batch) for batch in large.messages(range(6))] == [1] * 6, "8 MB of eps each"


def test_no_answer_is_larger_than_said() -> None:
    shapes = Shapes(trace=TRACE, frame=FRAME)
    for job in (0, PAIRS):
        for traces in ("none", "all"):
            spare = (
                len(codec.encode(replace(message([job], traces), traces=TRACES[:0])))
                if traces == "none"
                else 0
            )
            size = len(codec.encode(message([job], traces)))
            assert size <= shapes.answer_bytes() + 1000 + spare
