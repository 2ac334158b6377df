"""Messages of the worker's side, byte by byte: `python tests/vectors/vectors.py` writes them again
beside this file.

NAME.bin is a message as it travels; messages.json says what each holds. An array is {"dtype",
"shape", "values"} there.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from farm.net import codec, keys
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader
from farm.sim.trajectory import Trajectory

FOLDER = Path(__file__).parent
WORKER, RUN = "lab-1/4711-a1b2c3", "balance"
HEAD: dict[str, Any] = {"run": RUN, "incarnation": "0123456789abcdef", "round": 3}
JOBS = Jobs.joined(
    [
        Jobs.exploring(np.array([[0.5, -0.25], [1.0, 2.0]]), (1, -1), [(3, 0, 2, 0), (3, 0, 2, 1)]),
        Jobs.mean("control", [None]),
        Jobs.single(np.array([0.125, 4.0]), "physics", (3, 0, 1, 7)),
    ]
)
"""Two pairs, a rollout of the mean at control rate, and one of other parameters at physics rate."""


def _results(jobs: list[int], rollouts: int, **changed: Any) -> Results:
    values: dict[str, Any] = {
        "jobs": np.array(jobs, dtype="<i8"),
        "returns": 1.5 * np.arange(rollouts) - 2.0,
        "flags": np.tile([True, False, False, False], (rollouts, 1)),
        "steps": np.full(rollouts, 50, dtype="<i8"),
        "traces": np.empty((0, 0, 0), "<f4"),
        "trajectories": (),
    }
    return Results(**HEAD, worker=WORKER, **(values | changed))


MESSAGES: dict[str, tuple[str, object]] = {
    "want": (
        keys.want("farm", WORKER),
        WorkRequest(
            worker=WORKER,
            credits=128,
            idle=(),
            version="0.3.0",
            fingerprint="ab" * 32,
            host="lab-1",
            cores=8,
        ),
    ),
    "want-device": (
        keys.want("farm", WORKER),
        WorkRequest(
            worker=WORKER,
            credits=1,
            idle=(RUN,),
            version="rig 1",
            fingerprint="",
            host="lab-1",
            cores=1,
            ignored={"bad": 2},
        ),
    ),
    "spec": (
        keys.spec("farm", RUN),
        Spec(
            run=RUN,
            task="rig.py:Rig",
            task_config={"steps": 0, "gamma": 1.0, "perturb": True, "reward_offset": 0.0},
            policy="linear",
            policy_config={"normalise": False},
            code={"task": "01" * 32, "policy": "23" * 32, "simulation": "45" * 32},
            files={"model.xml": "<mujoco/>"},
            assets={"meshes/arm.stl": "89" * 32},
            constants={"origin": np.array([0.0, 1.0])},
        ),
    ),
    "round": (
        keys.generation("farm", RUN),
        RoundHeader(**HEAD, generation=2, spec="67" * 32, traces="none", mu=np.array([0.25, -1.0])),
    ),
    "round-normalised": (
        keys.generation("farm", RUN),
        RoundHeader(
            **HEAD,
            generation=2,
            spec="67" * 32,
            traces="extremes",
            mu=np.array([0.25, -1.0]),
            normaliser=np.array([[[0.5], [2.0]], [[0.0], [1.0]]]),
        ),
    ),
    "chunk": (keys.inbox("farm", WORKER), Chunk.carrying(JOBS, **HEAD)),
    "chunk-one": (keys.inbox("farm", WORKER), Chunk.carrying(JOBS.take([1]), **HEAD)),
    "results": (keys.result("farm", RUN, WORKER), _results([0, 1], 4)),
    "results-shown": (
        keys.result("farm", RUN, WORKER),
        _results(
            [1, 2],
            3,
            traces=np.array([[[0.5]], [[1.5]]], "<f4"),
            moments=np.array([[50.0, 0.5, 2.0]] * 3),
            trajectories=(
                Trajectory(
                    value=1.0,
                    success=None,
                    channels={"energy": np.array([[1.0], [2.0]], "<f4")},
                    times=np.array([0.0, 0.05]),
                    bodies=np.zeros((2, 1, 7), "<f4"),
                    actions=np.array([[0.0], [1.0]], "<f4"),
                    terms=np.array([[0.0], [1.0]], "<f4"),
                ),
            ),
        ),
    ),
    "failure": (
        keys.result("farm", RUN, WORKER),
        Failure(**HEAD, worker=WORKER, index=1, error="the guard tripped"),
    ),
    "failure-unserved": (
        keys.result("farm", RUN, WORKER),
        Failure(
            **HEAD,
            worker=WORKER,
            index=None,
            error="rig.py cannot be imported: line 3: KeyError: 'x'",
            traceback=('  File "rig.py", line 3, in <module>', "KeyError: 'x'"),
        ),
    ),
    "refusal": (
        keys.refused("farm", WORKER),
        Refusal(run=RUN, reason="its machine rounds differently"),
    ),
}
"""By name: the key that it travels on, and the message."""


def plain(value: Any) -> Any:
    """As JSON has it."""
    if isinstance(value, np.ndarray):
        return {
            "dtype": value.dtype.str,
            "shape": list(value.shape),
            "values": value.ravel().tolist(),
        }
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    return [plain(each) for each in value] if isinstance(value, tuple | list) else value


def described() -> str:
    """What messages.json says."""
    table = []
    for name, (key, message) in MESSAGES.items():
        entry = {"schema": codec.SCHEMA, "type": type(message).__name__, **plain(message)}
        table.append({"file": f"{name}.bin", "key": key, "message": entry})
    return json.dumps(table, indent=1) + "\n"


if __name__ == "__main__":
    for name, (_, message) in MESSAGES.items():
        (FOLDER / f"{name}.bin").write_bytes(codec.encode(message))
    (FOLDER / "messages.json").write_text(described())
