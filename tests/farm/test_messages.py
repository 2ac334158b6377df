"""Every message there and back bit for bit, and what each refuses."""

import contextlib
import dataclasses

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from farm import codec
from farm.errors import MessageError
from farm.messages import (
    RATES,
    Chunk,
    Failure,
    Generation,
    Job,
    Refusal,
    Result,
    Results,
    RunStatus,
    Spec,
    Want,
    WireTrajectory,
    WorkerStatus,
)
from farm.trajectory import Trajectory

RNG = np.random.default_rng(0)


def job(**changes):
    values = {
        "index": 4,
        "origin": "mu",
        "signs": (1, -1),
        "perturbation": (7, 2**64 - 1, 0),
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
        "steps": np.array([15, 3])[:rollouts],
        "dropped": np.array([False, True])[:rollouts],
        "failed": np.zeros(rollouts, dtype=bool),
        "clamped": np.zeros(rollouts, dtype=bool),
        "traces": RNG.exponential(size=(rollouts, steps, 54)).astype("<f4"),
    }
    return Result(**(values | changes))


HEAD = {"run": "run-1", "incarnation": "ab12", "round": 7}

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
        workers=(WorkerStatus(worker="host/a1", version="0.1.0", canary="c", rollouts=9, rate=0.9, seen=0.1),),
    ),  # fmt: skip
    "want": Want(worker="host/a1", credits=64, idle=False, version="0.1.0", assets="a", canary="c"),
    "want nothing": Want(worker="host/a1", credits=0, idle=True, version="", assets="a", canary="c"),
    "spec": Spec(
        run="run-1",
        task="finger-gait",
        task_config={"object": "bar", "steps": 15, "gamma": 0.95, "perturb": False},
        policy_config={"controller": "projected", "features": 50},
        frequencies=RNG.normal(size=(50, 8)),
        phases=RNG.uniform(size=50),
    ),
    "spec of a kernel": Spec(
        run="r", task="t", task_config={}, policy_config={}, frequencies=np.zeros((0, 8)), phases=np.zeros(0)
    ),
    "generation": Generation(**HEAD, generation=6, spec="0f" * 32, mu=RNG.normal(size=64), sigma=np.full(64, 2.0)),
    "job": job(),
    "job of one nominal rollout": job(signs=(1,), perturbation=None, rate="physics", origin="zero"),
    "job of the mean": job(signs=(1,), eps=np.zeros(0), rate="control", perturbation=()),
    "chunk": Chunk(**HEAD, jobs=(job(), job(index=5, signs=(-1,)))),
    "empty chunk": Chunk(**HEAD, jobs=()),
    "result": result(),
    "result of one": result(rollouts=1),
    "result without traces": result(steps=0),
    "result with a trajectory": result(trajectory=WireTrajectory.of(trajectory())),
    "results": Results(
        **HEAD, worker="host/a1", results=(result(), result(1, trajectory=WireTrajectory.of(trajectory())))
    ),
    "empty results": Results(**HEAD, worker="host/a1", results=()),
    "failure": Failure(**HEAD, worker="host/a1", index=3, error="ValueError: so it went"),
    "trajectory": WireTrajectory.of(trajectory()),
    "trajectory of one frame": WireTrajectory.of(trajectory(frames=1)),
    "trajectory of none": WireTrajectory.of(trajectory(frames=0, bodies=0)),
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
    "want": [{"credits": -1}, {"credits": 100_001}],
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
        {"perturbation": (-1,)},
    ],
    "result": [
        {"returns": np.zeros(1)},
        {"success": np.zeros(3, dtype=bool)},
        {"steps": np.zeros(1, dtype=np.int64)},
        {"dropped": np.zeros(0, dtype=bool)},
        {"failed": np.zeros(1, dtype=bool)},
        {"clamped": np.zeros(1, dtype=bool)},
        {"traces": np.zeros((3, 15, 54), dtype="<f4")},
    ],
    "trajectory": [
        *(
            {name: np.zeros((4, *shape[1:]), "<f4")}
            for name, shape in {
                "bodies": (4, 3, 6),
                "joints": (4, 7),
                "targets": (4, 9),
                "images": (4, 3, 17),
                "points": (4, 2, 3),
                "terms": (4, 4),
            }.items()
        ),
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


def test_a_result_speaks_of_one_or_two_rollouts():
    for count in (0, 3):
        with pytest.raises(ValueError, match="lengths"):
            dataclasses.replace(
                result(),
                returns=np.zeros(count),
                steps=np.zeros(count, dtype=np.int64),
                traces=np.zeros((count, 15, 54), "<f4"),
                **{name: np.zeros(count, dtype=bool) for name in ("success", "dropped", "failed", "clamped")},
            )


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
