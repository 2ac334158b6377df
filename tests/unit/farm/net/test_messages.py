"""Every message there and back bit for bit, and what each refuses."""

import contextlib
import dataclasses

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from farm.errors import MessageError
from farm.net import codec
from farm.net.work import RATES, Chunk, RoundHeader, Job, Jobs
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.work import Failure, Result, Results, WireTrajectory, traced
from farm.net.telemetry import Line, RunEnd, RunHistory, RunReport, RunStatus, Trace, WorkerStatus
from farm.sim.trajectory import Trajectory

RNG = np.random.default_rng(0)


def job(**changes):
    values = {
        "index": 4,
        "origin": "mu",
        "signs": (1, -1),
        "perturbation": (7, 2**32 - 1, 0, 5),
        "rate": "none",
        "eps": RNG.normal(size=64),
    }
    return Job(**(values | changes))


def trajectory(frames=4, bodies=3, **changes):
    values = {
        "times": np.arange(frames) * 0.1,
        "bodies": RNG.normal(size=(frames, bodies, 7)),
        "joints": RNG.normal(size=(frames, 8)),
        "targets": RNG.normal(size=(frames, 8)),
        "images": RNG.exponential(size=(frames, 3, 18)),
        "points": RNG.normal(size=(frames, 3, 3)),
        "terms": RNG.normal(size=(frames, 5)),
        "value": -5.4,
        "success": True,
    }
    return Trajectory(**(values | changes))


def result(rollouts=2, steps=15, **changes):
    values = {
        "index": 3,
        "trajectory": None,
        "returns": RNG.normal(size=rollouts),
        "success": np.array([True, False])[:rollouts],
        "dropped": np.array([False, True])[:rollouts],
        "failed": np.zeros(rollouts, dtype=bool),
        "clamped": np.zeros(rollouts, dtype=bool),
        "traces": RNG.exponential(size=(rollouts, steps, 54)).astype("<f4"),
    }
    return Result(**(values | changes))


def results(*parts, traces="all"):
    return Results.of(parts, **HEAD, worker="host/a1", traces=traces)


def report(**changes):
    trace = np.zeros((1, 15, 54), "<f4")
    values = {
        "run": "r",
        "incarnation": "i",
        "generation": 2,
        "progress": {"generation": 2, "baseline": None, "best": -0.5},
        "rate": 300.0,
        "lines": (Line(level="INFO", text="worker w joined"),),
        "traces": (Trace(name="best", values=trace), Trace(name="all", values=np.repeat(trace, 4, axis=0))),
        "sample": WireTrajectory.of(trajectory()),
    }
    return RunReport(**(values | changes))


HEAD = {"run": "run-1", "incarnation": "ab12", "round": 7}

JOBS = [
    job(),
    job(index=5, signs=(-1,), origin="zero"),
    job(index=0, signs=(1,), eps=np.zeros(0), rate="control", perturbation=None),
    job(index=2**31 - 1, rate="physics"),
]

TABLE = Jobs.of(JOBS).table


def changed(column, value):
    """The table with another value in its last row."""
    table = TABLE.copy()
    table[-1, column] = value
    return table


STRANGE = {  # by column
    0: (TABLE[0, 0], -1, 2**31, -(2**63)),  # a job twice
    1: (-1, 2),
    2: (-1, 2),
    3: (-1, len(RATES)),
    4: (0, 2, -2, -(2**63)),
    5: (2, -2),
    **{column: (-1, -2, 2**32) for column in range(6, 10)},  # half a seed
}

MESSAGES = {
    "refusal": Refusal(run="first", reason="its hand is another"),
    "status": RunStatus(
        run="first",
        generation=3,
        generations=150,
        return_mean=-5.4,
        mean_policy_return=None,
        open=4,
        reissued=1,
        refused=0,
        ignored={"stale": 2},
        workers=(
            WorkerStatus(
                worker="host/a1", host="h", cores=2, version="0.1.0", canary="c", rollouts=9, rate=0.9, seen=0.1
            ),
        ),
    ),  # fmt: skip
    "want": WorkRequest(
        worker="host/a1", credits=64, idle=(), version="0.1.0", assets="a", canary="c", host="h", cores=2
    ),
    "want nothing": WorkRequest(
        worker="host/a1", credits=0, idle=("run-1", "second"), version="", assets="a", canary="c", host="h", cores=2
    ),
    "spec": Spec(
        run="run-1",
        task="finger-gait",
        task_config={"object": "bar", "steps": 15, "gamma": 0.95, "perturb": False},
        policy_config={"controller": "projected", "features": 50},
        frequencies=RNG.normal(size=(50, 8)),
        phases=RNG.uniform(size=50),
    ),
    "spec of a kernel": Spec(
        run="r",
        task="t",
        task_config={},
        policy_config={},
        frequencies=np.zeros((0, 8)),
        phases=np.zeros(0),
    ),
    "generation": RoundHeader(**HEAD, generation=6, spec="0f" * 32, traces="all", mu=RNG.normal(size=64)),
    "job": job(),
    "job of one nominal rollout": job(signs=(1,), perturbation=None, rate="physics", origin="zero"),
    "job of the mean": job(signs=(1,), eps=np.zeros(0), rate="control", perturbation=None),
    "chunk": Chunk.carrying(Jobs.of(JOBS), **HEAD),
    "chunk of means": Chunk.carrying(Jobs.of(JOBS[2:3]), **HEAD),
    "results": results(result(), result(1, index=9, trajectory=WireTrajectory.of(trajectory())), result(index=0)),
    "results of one": results(result(rollouts=1)),
    "results without traces": results(result(steps=0), traces="none"),
    "results of two traces": results(result(index=1), result(index=2), result(index=3), traces="extremes"),
    "failure": Failure(**HEAD, worker="host/a1", index=3, error="ValueError: so it went"),
    "report": report(),
    "report of statistics": report(traces=(), sample=None, lines=()),
    "history": RunHistory(
        run="r",
        incarnation="i",
        recording="first",
        config={"seed": 0},
        generation=2,
        reports=(report(), report()),
        end=RunEnd(summary={"state": "finished"}, lines=(), best=None, best_generation=2, mean=None),
    ),
    "history of nothing": RunHistory(
        run="r", incarnation="i", recording="r", config={}, generation=0, reports=(), end=None
    ),
    "trajectory": WireTrajectory.of(trajectory()),
    "trajectory of one frame": WireTrajectory.of(trajectory(frames=1)),
}


def assert_same(one, two):
    assert type(one) is type(two)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (two.dtype, two.shape)
        assert one.tobytes() == two.tobytes()
    elif isinstance(one, tuple):
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            assert_same(a, b)
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name))
    else:
        assert one == two


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_comes_back_bit_for_bit(name):
    message = MESSAGES[name]
    payload = codec.encode(message)
    assert_same(message, codec.decode(payload, type(message)))
    assert codec.encode(codec.decode(payload, type(message))) == payload


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_taken_for_no_other(name):
    message = MESSAGES[name]
    for kind in {type(m) for m in MESSAGES.values()} - {type(message)}:
        with pytest.raises(MessageError, match=f"a {type(message).__name__} where a {kind.__name__} was expected"):
            codec.decode(codec.encode(message), kind)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_truncated_message_is_refused(name):
    payload = codec.encode(MESSAGES[name])
    for length in [*range(0, len(payload), max(1, len(payload) // 200)), len(payload) - 1]:
        with pytest.raises(MessageError):
            codec.decode(payload[:length], type(MESSAGES[name]))


@given(
    name=st.sampled_from(sorted(MESSAGES)),
    where=st.floats(0, 1),
    length=st.integers(0, 9),
    instead=st.binary(max_size=9),
)
def test_a_mutated_message_is_a_message_or_a_message_error(name, where, length, instead):
    payload = codec.encode(MESSAGES[name])
    start = int(where * min(len(payload), 400))  # structure stands in front
    with contextlib.suppress(MessageError):
        codec.decode(payload[:start] + instead + payload[start + length :], type(MESSAGES[name]))


# ---------------------------------------------------------------- what messages refuse

REFUSED = {
    "want": [
        {"credits": -1},
        {"credits": 100_001},
        {"idle": ("r",) * 1001},
        {"ignored": {"stale": "many"}},
        {"ignored": {"s" * 251: 1}},
        {"ignored": dict.fromkeys("abcdefghijklmnopqrstuvwxyz", 1)},
    ],
    "job": [
        {"origin": "sigma"},
        {"origin": ""},
        {"signs": ()},
        {"signs": (1, -1, 1)},
        {"signs": (0,)},
        {"signs": (2, -1)},
        {"rate": "all"},
        {"index": -1},
        {"index": 2**31},
        {"perturbation": ()},
        {"perturbation": (1, 2, 3)},
        {"perturbation": (1, 2, 3, -1)},
        {"perturbation": (1, 2, 2**32, 3)},
    ],
    "chunk": [
        {"table": np.zeros((0, 10), dtype=np.int64)},
        {"table": np.zeros((4, 0), dtype=np.int64)},
        {"table": TABLE[:3]},
        {"table": TABLE[:, :9]},
        {"table": np.hstack([TABLE, TABLE[:, :1]])},
        *({"table": changed(column, value)} for column, values in STRANGE.items() for value in values),
        {"eps": np.zeros((1, 64))},
        {"eps": np.zeros((4, 64))},
    ],
    "results": [
        {"jobs": np.zeros(2, dtype=np.int64)},
        {"jobs": np.zeros(0, dtype=np.int64)},
        {"jobs": np.arange(6)},
        {"jobs": np.array([0, 9, 3])},
        {"jobs": np.array([0, 3, 3])},
        {"returns": np.zeros(1)},
        {"flags": np.zeros((3, 4), dtype=bool)},
        {"flags": np.zeros((5, 3), dtype=bool)},
    ],
    "trajectory": [
        *(
            {name: np.zeros((3, *shape), "<f4")}
            for name, shape in {"bodies": (3, 7), "joints": (8,), "images": (3, 18), "terms": (5,)}.items()
        ),
        {"times": np.zeros(3)},
        {"times": np.zeros(0)},
    ],
}
CASES = [(name, change) for name, changes in REFUSED.items() for change in changes]


@pytest.mark.parametrize(("name", "change"), CASES, ids=[f"{n}-{'-'.join(c)}-{i}" for i, (n, c) in enumerate(CASES)])
def test_values_that_make_no_sense_are_refused(name, change):
    message = MESSAGES[name]
    with pytest.raises(ValueError, match="."):
        dataclasses.replace(message, **change)
    packed = {key: list(value) if isinstance(value, tuple) else value for key, value in change.items()}
    plain = msgpack.unpackb(codec.encode(message), ext_hook=msgpack.ExtType) | packed
    with pytest.raises(MessageError, match=f"^{type(message).__name__}: "):
        codec.decode(msgpack.packb(plain, default=codec._pack), type(message))


@pytest.mark.parametrize(("name", "field"), [("refusal", "reason"), ("results", "worker"), ("failure", "worker")])
def test_texts_have_an_end(name, field):
    said = dataclasses.replace(MESSAGES[name], **{field: "x" * 1001})
    with pytest.raises(MessageError, match=r"a text of 1001 characters, at most 1000 are taken"):
        codec.decode(codec.encode(said), type(said))


@pytest.mark.parametrize("column", range(6, 10))
@pytest.mark.parametrize("others", [JOBS, JOBS[:2]], ids=["some nominal", "none nominal"])
def test_a_seed_is_whole_or_not_there(others, column):
    jobs = Jobs.of(others)
    jobs.table[0, column] = -1
    with pytest.raises(ValueError, match="half a seed"):
        Chunk.carrying(jobs, **HEAD)


def test_a_chunk_has_jobs():
    with pytest.raises(ValueError, match=r"jobs in a table of shape \(0, 10\)"):
        Chunk(table=TABLE[:0], eps=np.empty((0, 0)), **HEAD)


def test_jobs_are_split_as_they_were_put_together():
    back = codec.decode(codec.encode(Chunk.carrying(Jobs.of(JOBS), **HEAD)), Chunk).split()
    assert len(back) == len(JOBS)
    for one, two in zip(JOBS, back, strict=True):
        assert_same(one, two)


@pytest.mark.parametrize("signs", [(1, -1), (1,)])
@pytest.mark.parametrize("seeds", [None, [(1, 2, 3, i) for i in range(5)]])
@pytest.mark.parametrize("replayed", [False, True])
def test_jobs_that_explore_are_as_those_put_together_one_by_one(signs, seeds, replayed):
    eps = RNG.normal(size=(5, 7))
    one_by_one = [
        job(index=i, signs=signs, perturbation=seeds[i] if seeds else None, eps=row, rate="none", origin="mu")
        for i, row in enumerate(eps)
    ]
    then = [job(index=5, signs=(1,), eps=np.zeros(0), rate="control", perturbation=None)]
    then += [job(index=6, signs=(1,), eps=eps[2], rate="physics", origin="zero")] if replayed else []
    assert_same(Jobs.exploring(eps, signs, seeds, then), Jobs.of([*one_by_one, *then]))


@pytest.mark.parametrize("chosen", [[0], [3], [1, 2], [2, 3], [0, 1, 2, 3], [0, 2], [3, 1], [2, 1, 3, 0]])
def test_some_jobs_are_as_those_put_together(chosen):
    assert_same(Jobs.of(JOBS).take(chosen), Jobs.of([JOBS[i] for i in chosen]))


def test_results_stand_in_the_jobs_order():
    parts = [result(), result(1, index=9, trajectory=WireTrajectory.of(trajectory())), result(index=0)]
    back = codec.decode(codec.encode(results(*parts)), Results)
    assert back.jobs.tolist() == [0, 3, 9]
    assert back.returns.tolist() == [*parts[2].returns, *parts[0].returns, *parts[1].returns]
    assert back.flags[:, 1].tolist() == [*parts[2].dropped, *parts[0].dropped, *parts[1].dropped]
    # Who is seen does not explore, and so has no trace.
    assert back.traces.tobytes() == parts[2].traces.tobytes() + parts[0].traces.tobytes()


@pytest.mark.parametrize(
    ("returns", "expected"), [([0.5, 2.0, -1.0, 1.0], [1, 2]), ([1.0, 2.0, 2.0, 1.0], [0, 1]), ([3.0] * 4, [0])]
)
def test_traces_of_the_best_and_the_worst(returns, expected):
    seen = result(1, index=0, trajectory=WireTrajectory.of(trajectory()), returns=np.array([9.0]))
    parts = [seen, *(result(index=i, returns=np.array(returns[2 * i - 2 : 2 * i])) for i in (1, 2))]
    back = results(*parts, traces="extremes")
    exploring = np.array([False, True, True, True, True])
    assert traced("extremes", back.returns, exploring).tolist() == [1 + row for row in expected]
    for row, trace in zip(expected, back.traces, strict=True):
        assert trace.tobytes() == parts[1 + row // 2].traces[row % 2].tobytes()
    assert not results(seen, traces="extremes").traces.size
    assert not results(*parts, traces="none").traces.size


@pytest.mark.parametrize("times", [[], [0.1], [0.0, 0.2, 0.1], [0.0, 0.0]])
def test_frames_begin_at_the_release_and_rise(times):
    shown = trajectory(frames=len(times), times=np.array(times))
    with pytest.raises(ValueError, match="begin at 0"):
        WireTrajectory.of(shown)


@pytest.mark.parametrize("text", ["x" * 1001, "two\nlines", "\x1b[2J"])
def test_texts_that_cannot_be_shown_are_refused(text):
    with pytest.raises(ValueError, match="unprintable"):
        dataclasses.replace(MESSAGES["failure"], error=text)
    with pytest.raises(ValueError, match="unprintable"):
        dataclasses.replace(MESSAGES["want"], host=text)


def test_results_of_nothing_are_refused():
    shapes = {"traces": (0, 15, 54), "flags": (0, 4)}
    arrays = [f for f in dataclasses.fields(Results) if "dtype" in f.metadata]
    nothing = {f.name: np.zeros(shapes.get(f.name, 0), f.metadata["dtype"]) for f in arrays}
    with pytest.raises(ValueError, match="0 jobs of 0 rollouts"):
        dataclasses.replace(results(result()), **nothing)


def test_rates():
    assert RATES == ("none", "control", "physics")
    for rate in RATES:
        assert job(rate=rate).rate == rate


# ---------------------------------------------------------------- trajectories


def test_a_trajectory_comes_back_to_single_precision():
    sent = trajectory()
    back = codec.decode(codec.encode(WireTrajectory.of(sent)), WireTrajectory).trajectory()
    for field in dataclasses.fields(Trajectory):
        one, two = getattr(sent, field.name), getattr(back, field.name)
        if field.name in ("times", "value", "success"):
            np.testing.assert_array_equal(one, two)
        else:
            assert two.dtype == np.float64
            np.testing.assert_array_equal(one.astype("f4").astype("f8"), two)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, 1e300, -1e300, np.nan])
def test_a_trajectory_of_overflowing_terms_can_be_sent(bad):
    terms = np.zeros((4, 5))
    terms[2, 2] = bad
    payload = codec.encode(WireTrajectory.of(trajectory(terms=terms)))
    back = codec.decode(payload, WireTrajectory).trajectory()
    assert np.isfinite(back.terms).all()
    assert back.terms[2, 2] == np.float32(1e30 if bad > 0 else -1e30)
    assert not back.terms[:2].any()


@pytest.mark.parametrize(
    ("name", "shape"), [("best", (2, 15, 54)), ("worst", (0, 15, 54)), ("all", (4, 15, 53)), ("../best", (1, 15, 54))]
)
def test_traces_that_make_no_sense_are_refused(name, shape):
    with pytest.raises(ValueError, match="traces "):
        Trace(name=name, values=np.zeros(shape, "<f4"))


HAND = {"bodies": (3, 7), "joints": (8,), "targets": (8,), "images": (3, 18), "points": (3, 3), "terms": (5,)}


@pytest.mark.parametrize(
    ("name", "width"),
    [("bodies", (3, 6)), ("bodies", (2, 7)), ("joints", (7,)), ("targets", (9,)), ("images", (3, 17)),
     ("images", (0, 18)), ("points", (2, 3)), ("terms", (4,))],
)  # fmt: skip
def test_a_trajectory_fits_its_runs_task_or_not(name, width):
    good = WireTrajectory.of(trajectory())
    assert good.fits(HAND)
    other = dataclasses.replace(good, **{name: np.zeros((4, *width), "<f4")})
    assert codec.decode(codec.encode(other), WireTrajectory).fits(HAND | {name: width})
    assert not other.fits(HAND)
