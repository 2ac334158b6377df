"""Checkpoints: read back bit for bit; a damaged or incomplete one is never used."""

import errno
import hashlib
import os
from dataclasses import fields, replace
from pathlib import Path

import made
import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from farm.errors import CheckpointError
from farm.net import codec
from learner.algorithms import PGPE, PGPEState
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import BestRollout, Checkpoint, load, save, settle
from learner.run.config import RunConfig, to_dict

RNG = np.random.default_rng(3)
P = 12

BEST = BestRollout(seed=(3, 0, 1, 2), theta=RNG.normal(size=P))

EXTREMES = np.array([0.0, -0.0, 5e-324, -1.7e308, np.pi, 1.0 / 3.0] * 2)


def checkpoint(**changed: object) -> Checkpoint:
    state = PGPE(optimiser="adam").init(P)
    state = replace(
        state, mu=EXTREMES, sigma=np.abs(EXTREMES) + 1e-300, best=-0.1, baseline=1 / 3, generation=7
    )
    values = {
        "run": "first",
        "config": to_dict(RunConfig(seed=3)),
        "state": state.to_dict(),
        "rollouts": 210,
        "reissued": 4,
        "seconds": 12.3456789012345678,
        "solved": 2,
        "best": BEST,
        "best_generation": 5,
        "fingerprint": "c0",
        "replayed": False,
        "code": {"task": "0f" * 32, "policy": "1e" * 32, "simulation": ""},
        "files": {"model.xml": "<mujoco/>" * 999},
        "constants": {"frequencies": RNG.normal(size=(5, 8)), "phases": EXTREMES},
    }
    return made.checkpoint(**(values | changed))


def bits(value: object) -> object:
    """Something that is equal only for equal bits."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if isinstance(value, (Checkpoint, BestRollout)):
        return {field.name: bits(getattr(value, field.name)) for field in fields(value)}
    return repr(value)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint"
    save(path, checkpoint())
    return path.read_bytes()


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {
            "best": None,
            "replayed": True,
            "fingerprint": "",
            "constants": {},
            "files": {},
            "code": {},
        },
        {"best": BestRollout(seed=None, theta=EXTREMES)},
        {
            "best": BestRollout(seed=None, theta=EXTREMES, normaliser=EXTREMES.reshape(2, 6)),
            "moments": EXTREMES[:5],
            "steps": 10**12,
        },
    ],
    ids=range(4),
)
def test_there_and_back(tmp_path: Path, changed: dict[str, object]) -> None:
    original = checkpoint(**changed)
    save(tmp_path / "checkpoint", original)
    back = load(tmp_path / "checkpoint")
    assert bits(back) == bits(original)
    state = PGPE(optimiser="adam").restore(back.state)
    assert isinstance(state, PGPEState)
    assert bits(dict(state.to_dict())) == bits(original.state)
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint"]


def test_truncated_anywhere(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "checkpoint"
    lengths = {*range(70), *range(70, len(whole), 101), *range(len(whole) - 40, len(whole))}
    for length in sorted(lengths):
        path.write_bytes(whole[:length])
        with pytest.raises(
            CheckpointError, match="truncated or damaged|not a checkpoint|another version"
        ):
            load(path)


@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_flipped_bits(tmp_path: Path, whole: bytes, data: st.DataObject) -> None:
    damaged = bytearray(whole)
    for position in data.draw(st.sets(st.integers(0, 8 * len(whole) - 1), min_size=1, max_size=4)):
        damaged[position // 8] ^= 1 << position % 8
    path = tmp_path / "checkpoint"
    path.write_bytes(damaged)
    with pytest.raises(CheckpointError):
        load(path)


def test_something_appended(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(whole + b"\0")
    with pytest.raises(CheckpointError, match="truncated or damaged"):
        load(path)


def test_of_before_there_were_statistics_of_observations(tmp_path: Path) -> None:
    path, original = tmp_path / "checkpoint", checkpoint()
    save(path, original)
    body = codec.encode(original, 2)
    head = path.read_bytes()[: -len(body) - hashlib.sha256().digest_size]
    plain = msgpack.unpackb(body, ext_hook=msgpack.ExtType)
    del plain["moments"], plain["steps"], plain["best"]["normaliser"]
    old = msgpack.packb(plain)
    path.write_bytes(head + hashlib.sha256(old).digest() + old)
    assert bits(load(path)) == bits(original)


def test_of_another_version(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(whole.replace(b"checkpoint 2\n", b"checkpoint 3\n", 1))
    with pytest.raises(CheckpointError, match="of another version; use the release that wrote it"):
        load(path)


def test_of_another_schema(tmp_path: Path, whole: bytes) -> None:
    body, kind = codec.encode(checkpoint(), 3), whole.partition(b"\n")[0]
    (tmp_path / "checkpoint").write_bytes(kind + b"\n" + hashlib.sha256(body).digest() + body)
    with pytest.raises(CheckpointError, match="schema version 3"):
        load(tmp_path / "checkpoint")


def test_none_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint at .*: is this a run's folder"):
        load(tmp_path / "checkpoint")
    with pytest.raises(CheckpointError, match="Is a directory"):
        load(tmp_path)


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_failure_leaves_the_old_one(
    tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(whole)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoints.os if call == "fsync" else Path, call, full)
    with pytest.raises(OSError, match="No space left"):
        save(path, checkpoint(rollouts=240), durable=True)
    monkeypatch.undo()
    assert path.read_bytes() == whole
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint"], (
        "the torn new one takes room"
    )
    save(path, checkpoint(rollouts=240))
    assert load(path).rollouts == 240


@pytest.mark.slow
def test_more_than_a_message_may_hold(tmp_path: Path) -> None:
    large = checkpoint(constants={"frequencies": np.ones((codec.MAX_BYTES // 8 + 1, 1))})
    save(tmp_path / "checkpoint", large)
    assert (tmp_path / "checkpoint").stat().st_size > codec.MAX_BYTES
    assert (
        load(tmp_path / "checkpoint").constants["frequencies"].shape
        == large.constants["frequencies"].shape
    )


def test_a_file_that_a_power_failure_tore_has_a_copy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "checkpoint"
    save(path, checkpoint(rollouts=1), durable=True)
    save(path, checkpoint(rollouts=2))
    assert load(path).rollouts == 2
    assert not caplog.records

    path.write_bytes(path.read_bytes()[:-100])
    assert load(path).rollouts == 1
    assert (
        "checkpoint is missing or damaged; continuing from its copy checkpoint.safe" in caplog.text
    )


def test_a_run_that_is_over_has_one_file(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    save(path, checkpoint(rollouts=1), durable=True)
    save(path, checkpoint(rollouts=2))
    settle(path)
    assert [each.name for each in tmp_path.iterdir()] == ["checkpoint"]
    path.write_bytes(b"")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        load(path)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"generation": -5}, "its generation is '-5'"),
        ({"generation": 10**15}, "its generation is '1000000000000000'; expected 0 to 10000000"),
        ({"generation": "soon"}, "its generation is 'soon'"),
        ({"mu": 3.0}, "its mu is no vector of numbers"),
        ({"mu": np.ones((2, 2))}, "its mu is no vector of numbers"),
        ({"mu": np.array([0.5])}, "its mu and sigma have different lengths"),
        ({"sigma": None}, "its sigma is no vector of numbers"),
    ],
)
def test_made_up_states(tmp_path: Path, changed: dict[str, object], reason: str) -> None:
    sound = checkpoint()
    save(tmp_path / "checkpoint", replace(sound, state=sound.state | changed))
    with pytest.raises(CheckpointError, match=reason):
        load(tmp_path / "checkpoint")
    missing = {name: value for name, value in sound.state.items() if name not in changed}
    save(tmp_path / "checkpoint", replace(sound, state=missing))
    with pytest.raises(CheckpointError, match=f"its {next(iter(changed))} is "):
        load(tmp_path / "checkpoint")


def test_made_up_constants_and_files(tmp_path: Path) -> None:
    save(tmp_path / "checkpoint", checkpoint(constants={"frequencies": 3}))
    with pytest.raises(CheckpointError, match="a constant of its policy is no array"):
        load(tmp_path / "checkpoint")
    save(tmp_path / "checkpoint", checkpoint(assets={"mesh.stl": "../../secret"}))
    with pytest.raises(CheckpointError, match="a file 'mesh.stl' without a SHA-256"):
        load(tmp_path / "checkpoint")
