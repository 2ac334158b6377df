"""Every message encoded and decoded bit for bit, invalid messages, and jobs as one table."""

import contextlib
import dataclasses
from collections.abc import Mapping

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made import stats
from wire import pack

from farm.errors import MessageError
from farm.net import codec
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.telemetry import Line, Report, RunEnd, RunHistory, RunStatus, WorkerStatus
from farm.net.work import RATES, Chunk, Failure, Jobs, Results, RoundHeader, Simulated, traced
from farm.sim.trajectory import Trajectory

RNG = np.random.default_rng(0)
P = 16
STATS = stats(2, baseline=None, mean_policy_success=None, success_rate=None)
HEAD = {"run": "run-1", "incarnation": "ab12", "round": 7}
SHAPES = {"bodies": (3, 7), "actions": (2,), "terms": (2,), "channels/force": (3,), "channels/images": (2, 3, 4)}


def trajectory(frames=4, **changes):
    values = {
        "times": np.arange(frames) * 0.1,
        "bodies": RNG.normal(size=(frames, 3, 7)),
        "actions": RNG.normal(size=(frames, 2)),
        "terms": RNG.normal(size=(frames, 2)),
        "channels": {"force": RNG.normal(size=(frames, 3)), "images": RNG.normal(size=(frames, 2, 3, 4))},
        "value": -5.4,
        "success": True,
    }
    return Trajectory.of(**(values | changes))


WIRE = trajectory()
EPS = RNG.normal(size=(3, P))
SEEDS = [(7, 2**32 - 1, 0, 5), (1, 2, 3, 4), (0, 0, 0, 0)]
JOBS = Jobs.joined(
    [
        Jobs.exploring(EPS, (1, -1), SEEDS),
        Jobs.mean("control", [None, (9, 9, 9, 9)]),
        Jobs.single(EPS[0], "physics", (3, 0, 4, 1)),
    ]
)
TABLE = JOBS.table


def report(**changes):
    trace = np.zeros((15, 6), "<f4")
    values = {
        "incarnation": "i",
        "progress": STATS,
        "rate": 300.0,
        "lines": (Line(level="INFO", text="worker w joined"),),
        "traces": {"best": trace, "all": np.repeat(trace[None], 4, axis=0)},
        "sample": WIRE,
    }
    return Report(**(values | changes))


MESSAGES = {
    "refusal": Refusal(run="first", reason="its hand is another"),
    "status": RunStatus(
        run="first", generation=3, generations=150, return_mean=-5.4, mean_policy_return=None, open=4, reissued=1,
        refused=0, ignored={"stale": 2}, workers=(
            WorkerStatus(worker="host/a1", host="h", cores=2, version="0", canary="c", rollouts=9, rate=0.9, seen=0.1),
        ),
    ),
    "request": WorkRequest(worker="host/a1", credits=64, idle=(), version="0.1.0", canary="c", host="h", cores=2),
    "request for nothing": WorkRequest(
        worker="host/a1", credits=0, idle=("run-1", "second"), version="", canary="c", host="h", cores=2
    ),
    "spec": Spec(
        run="run-1", task="pole.py:Pole", task_config={"width": 0.5, "steps": 15, "perturb": False}, policy="direct",
        policy_config={"features": 5}, code={"task": "0f", "policy": "1e", "simulation": "2d"}, release="", files={
            "model.xml": "<mujoco/>" * 1000
        }, constants={"frequencies": RNG.normal(size=(5, 8)), "phases": RNG.uniform(size=5)},
    ),
    "spec of a package": Spec(
        run="r", task="gym:Swimmer-v5", task_config={}, policy="kernel", policy_config={}, code={}, release="a 1",
        policy_release="b 2", task_release="gymnasium 1.4",
    ),
    "round": RoundHeader(**HEAD, generation=6, spec="0f" * 32, traces="all", mu=RNG.normal(size=P)),
    "normalised round": RoundHeader(
        **HEAD, generation=6, spec="0f", traces="all", mu=np.zeros(2), normaliser=RNG.uniform(0.1, 1.0, (2, 2, 3))
    ),
    "chunk": Chunk.carrying(JOBS, **HEAD),
    "chunk of means": Chunk.carrying(JOBS.take([3]), **HEAD),
    "results": Results(
        **HEAD, worker="host/a1", jobs=np.array([0, 3, 9]), returns=RNG.normal(size=5),
        flags=RNG.random((5, 4)) < 0.5,
        steps=np.arange(1, 6), traces=RNG.exponential(size=(4, 15, 6)).astype("<f4"), trajectories=(WIRE,),
    ),
    "results of one": Results(
        **HEAD, worker="w/1", jobs=np.array([4]), returns=np.zeros(1), flags=np.zeros((1, 4), bool),
        steps=np.ones(1, "<i8"), traces=np.empty((0, 15, 0), "<f4"), trajectories=(),
    ),
    "results with moments": Results(
        **HEAD, worker="w/1", jobs=np.array([4]), returns=np.zeros(2), flags=np.zeros((2, 4), bool),
        steps=np.ones(2, "<i8"), traces=np.empty((0, 15, 0), "<f4"), trajectories=(), moments=RNG.uniform(size=(2, 7)),
    ),
    "failure": Failure(**HEAD, worker="host/a1", index=3, error="ValueError: so it went"),
    "failure of a class from a file": Failure(
        **HEAD, worker="host/a1", index=3, error="ValueError: so", traceback=('  File "a.py", line 3', "ValueError: so")
    ),
    "failure of all": Failure(**HEAD, worker="host/a1", index=None, error="not served"),
    "report": report(),
    "report of statistics": report(traces={}, sample=None, lines=()),
    "history": RunHistory(
        run="r", incarnation="i", recording="first", config={"seed": 0}, files={"model.xml": "<mujoco/>"},
        generation=2, reports=(report(), report()),
        end=RunEnd(summary={"state": "finished"}, lines=(), best=None, best_generation=2, mean=None),
    ),
    "history of nothing": RunHistory(
        run="r", incarnation="i", recording="r", config={}, files={}, generation=0, reports=(), end=None
    ),
    "trajectory": WIRE,
    "trajectory of one frame": trajectory(frames=1, success=None, channels={}),
}  # fmt: skip


def assert_same(one, two):
    assert type(one) is type(two)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (two.dtype, two.shape)
        assert one.tobytes() == two.tobytes()
    elif isinstance(one, tuple):
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            assert_same(a, b)
    elif isinstance(one, Mapping):
        assert list(one) == list(two)
        for name in one:
            assert_same(one[name], two[name])
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name))
    else:
        assert one == two


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_comes_back_bit_for_bit_and_is_taken_for_no_other(name):
    message = MESSAGES[name]
    payload = codec.encode(message)
    back = codec.decode(payload, type(message))
    assert_same(message, back)
    assert codec.encode(back) == payload
    for kind in {type(m) for m in MESSAGES.values()} - {type(message)}:
        with pytest.raises(MessageError, match=f"a {type(message).__name__} where a {kind.__name__} was expected"):
            codec.decode(payload, kind)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_truncated_message_is_refused(name):
    payload = codec.encode(MESSAGES[name])
    for length in [*range(0, len(payload), max(1, len(payload) // 50)), len(payload) - 1]:
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

NONE = np.zeros(0, "<i8")
REFUSED = {
    "request": [
        {"credits": -1},
        {"credits": 100_001},
        {"idle": ("r",) * 1001},
        {"ignored": {"stale": "many"}},
        {"ignored": {"s" * 251: 1}},
        {"ignored": dict.fromkeys("abcdefghijklmnopqrstuvwxyz", 1)},
        {"worker": "a/" + "1" * 250},
        {"host": "\x1b[2J"},
    ],
    "round": [{"traces": "some"}],
    "normalised round": [
        {"normaliser": np.ones((2, 1, 3))},
        {"normaliser": np.zeros((2, 2, 3))},
    ],
    "results with moments": [
        {"moments": np.zeros((1, 7))},
        {"moments": np.zeros((2, 6))},
        {"moments": np.full((2, 7), -1.0)},
        {"moments": np.array([[1.0, 0.0, 1.0, 1.0, -1.0]] * 2)},
    ],
    "spec": [
        {"code": {"task": 1}},
        {"files": {"model.xml": None}},
        {"files": {b"model.xml": ""}},
        {"constants": {"phases": 1.0}},
        {"constants": {"phases": [1.0]}},
        {"constants": {"phases": np.zeros(5, "<f4")}},
        {"constants": {"phases": np.array([np.nan])}},
    ],
    "chunk": [
        {"table": np.zeros((0, 10), dtype=np.int64)},
        {"table": np.zeros((4, 0), dtype=np.int64)},
        {"table": TABLE[:3]},
        {"table": TABLE[:, :9]},
        {"table": np.hstack([TABLE, TABLE[:, :1]])},
        *({"table": changed(column, value)} for column, values in STRANGE.items() for value in values),
        {"eps": np.zeros((1, P))},
        {"eps": np.zeros((5, P))},
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
        {"steps": np.ones(4, dtype=np.int64)},
    ],
    "results of one": [
        {"jobs": NONE, "returns": np.zeros(0), "flags": np.zeros((0, 4), bool), "steps": NONE},
    ],
    "failure": [{"error": text} for text in ("x" * 1001, "two\nlines", "\x1b[2J")],
    "trajectory": [
        {"bodies": np.zeros((3, 3, 7), "<f4")},
        {"actions": np.full((4, 2), np.inf, "<f4")},
        *({"times": np.array(times)} for times in ([], [0.1], [0.0, 0.2, 0.1, 0.3], [0.0, 0.0, 0.1, 0.2])),
        *(
            {"channels": {"force": wrong}}
            for wrong in (
                1.0, [0.0] * 4, "four", np.zeros((3, 3), "<f4"), np.zeros((4, 3)), np.zeros((), "<f4"),
                np.full((4, 3), np.nan, "<f4"),
            )
        ),
        {"channels": {f"c{i}": np.zeros((4, 1), "<f4") for i in range(101)}},
    ],
}  # fmt: skip
CASES = [(name, change) for name, changes in REFUSED.items() for change in changes]


@pytest.mark.parametrize(("name", "change"), CASES, ids=[f"{n}-{'-'.join(c)}-{i}" for i, (n, c) in enumerate(CASES)])
def test_values_that_make_no_sense_are_refused(name, change):
    message = MESSAGES[name]
    with pytest.raises(ValueError, match="."):
        dataclasses.replace(message, **change)
    packed = {key: list(value) if isinstance(value, tuple) else value for key, value in change.items()}
    plain = msgpack.unpackb(codec.encode(message), ext_hook=msgpack.ExtType) | packed
    with pytest.raises(MessageError, match=f"^{type(message).__name__}[:.]"):
        codec.decode(pack(plain), type(message))


@pytest.mark.parametrize(("name", "field"), [("refusal", "reason"), ("results", "worker"), ("spec", "task")])
def test_texts_have_an_end(name, field):
    said = dataclasses.replace(MESSAGES[name], **{field: "x" * 1001})
    with pytest.raises(MessageError, match=r"a text of 1001 characters, at most 1000 are taken"):
        codec.decode(codec.encode(said), type(said))


@pytest.mark.parametrize(
    ("name", "shape"), [("best", (2, 15, 54)), ("worst", (0, 15, 54)), ("../best", (1, 15, 54))]
)  # fmt: skip
def test_traces_that_make_no_sense_are_refused(name, shape):
    with pytest.raises(ValueError, match="traces "):
        report(traces={name: np.zeros(shape, "<f4")})


# ---------------------------------------------------------------- jobs


def test_parameters_and_seeds_of_jobs():
    mu = RNG.normal(size=P)
    assert JOBS.indices.tolist() == [0, 1, 2, 3, 4, 5]
    assert JOBS.rollouts.tolist() == [2, 2, 2, 1, 1, 1]
    assert JOBS.seen.tolist() == [False, False, False, True, True, True]
    assert JOBS.physics.tolist() == [False] * 5 + [True]
    expected = [*(mu + sign * eps for eps in EPS for sign in (1, -1)), mu, mu, EPS[0]]
    assert JOBS.theta(mu).tobytes() == np.array(expected).tobytes()
    pairs = [seed for seed in SEEDS for _ in range(2)]
    assert JOBS.seeds() == [*pairs, None, (9, 9, 9, 9), (3, 0, 4, 1)]


def test_jobs_without_eps_and_of_one_sign():
    mu, eps = RNG.normal(size=P), RNG.normal(size=(2, P))
    assert Jobs.mean("none", [None, SEEDS[0]]).theta(mu).tolist() == [mu.tolist()] * 2
    single = Jobs.exploring(eps, (-1,), None)
    assert single.theta(mu).tobytes() == (mu - eps).tobytes()
    assert single.seeds() == [None, None]
    assert not single.seen.any()
    assert mu.tolist() != eps[0].tolist()
    means_first = Jobs.joined([Jobs.mean("control", [None]), Jobs.exploring(eps, (1, -1), None)])
    assert means_first.theta(mu)[[0, 1, 4]].tobytes() == np.array([mu, mu + eps[0], mu - eps[1]]).tobytes()


@pytest.mark.parametrize("chosen", [[0], [3], [5], [1, 2], [3, 4], [0, 1, 2, 3, 4, 5], [0, 2], [5, 1], [4, 1, 5, 0]])
def test_some_jobs_are_the_same_jobs(chosen):
    mu, some = RNG.normal(size=P), JOBS.take(chosen)
    starts = np.cumsum(JOBS.rollouts) - JOBS.rollouts
    rows = [row for job in chosen for row in range(starts[job], starts[job] + JOBS.rollouts[job])]
    assert some.indices.tolist() == chosen
    assert some.theta(mu).tobytes() == JOBS.theta(mu)[rows].tobytes()
    assert some.seeds() == [JOBS.seeds()[row] for row in rows]
    Chunk.carrying(some, **HEAD)
    back = codec.decode(codec.encode(Chunk.carrying(some, **HEAD)), Chunk).take(range(len(chosen)))
    assert back.theta(mu).tobytes() == some.theta(mu).tobytes()


def test_results_carry_the_jobs_indices():
    given_ = Simulated(
        returns=np.arange(3.0), flags=np.zeros((3, 4), bool), steps=np.ones(3, "<i8"),
        traces=np.zeros((0, 0, 0), "<f4"), trajectories=(WIRE,),
    )  # fmt: skip
    made = Results.carrying(given_, JOBS.take([1, 3]), 0.5, **HEAD, worker="w/1")
    assert codec.decode(codec.encode(made), Results).jobs.tolist() == [1, 3]


# ---------------------------------------------------------------- traces


@pytest.mark.parametrize(
    ("returns", "expected"), [([0.5, 2.0, -1.0, 1.0], [1, 2]), ([1.0, 2.0, 2.0, 1.0], [0, 1]), ([3.0] * 4, [0])]
)
def test_traces_of_the_best_and_the_worst(returns, expected):
    returns, exploring = np.array([9.0, *returns]), np.array([False, True, True, True, True])
    assert traced("extremes", returns, exploring).tolist() == [1 + row for row in expected]
    assert traced("all", returns, exploring).tolist() == [1, 2, 3, 4]
    assert not traced("none", returns, exploring).size
    assert not traced("extremes", returns, np.zeros(5, bool)).size


# ---------------------------------------------------------------- trajectories


def test_a_trajectory_comes_back_to_single_precision():
    sent = trajectory()
    back = codec.decode(codec.encode(sent), Trajectory)
    assert (back.value, back.success, back.times.tolist()) == (sent.value, sent.success, sent.times.tolist())
    assert list(back.arrays()) == list(sent.arrays())
    for name, values in back.arrays().items():
        assert values.dtype == np.float32
        np.testing.assert_array_equal(sent.arrays()[name], values)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, 1e300, -1e300, np.nan])
def test_a_trajectory_of_overflowing_numbers_can_be_sent(bad):
    values = np.zeros((4, 2))
    values[2, 1] = bad
    payload = codec.encode(trajectory(terms=values, channels={"force": values}))
    back = codec.decode(payload, Trajectory)
    for shown in (back.terms, back.channels["force"]):
        assert shown[2, 1] == np.float32(1e30 if bad > 0 else -1e30)
        assert not shown[:2].any()


@pytest.mark.parametrize(
    ("name", "width"),
    [("bodies", (3, 6)), ("bodies", (2, 7)), ("actions", (1,)), ("terms", (4,)), ("channels/force", (2,)),
     ("channels/images", (2, 12)), ("channels/more", (1,))],
)  # fmt: skip
def test_a_trajectory_fits_its_runs_task_or_not(name, width):
    assert WIRE.fits(SHAPES)
    assert not WIRE.fits({name: shape for name, shape in SHAPES.items() if name != "channels/force"})
    values, (kind, _, channel) = np.zeros((4, *width), "<f4"), name.partition("/")
    change = {"channels": WIRE.channels | {channel: values}} if channel else {kind: values}
    other = codec.decode(codec.encode(dataclasses.replace(WIRE, **change)), Trajectory)
    assert other.fits(SHAPES | {name: width})
    assert not other.fits(SHAPES)


@pytest.mark.parametrize("lines", [["x"] * 41, ["x" * 1001], ["\x1b[2J"], ["two\nlines"]], ids=range(4))
def test_a_traceback_that_cannot_be_shown_is_refused(lines: list[str]) -> None:
    body = {"schema": codec.SCHEMA, "type": "Failure", **HEAD, "worker": "w/1", "index": 0, "error": "e"}
    assert codec.decode(msgpack.packb(body | {"traceback": ["  x"]}), Failure).traceback == ("  x",)
    with pytest.raises(MessageError):
        codec.decode(msgpack.packb(body | {"traceback": lines}), Failure)
