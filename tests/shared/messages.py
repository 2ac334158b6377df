"""Messages of every kind, with values of every kind, and the jobs that some of them carry."""

import dataclasses
from typing import Any

import numpy as np
from made import report, stats

from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.telemetry import Line, RunEnd, RunHistory, RunStatus, WorkerStatus
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader
from farm.sim.trajectory import Trajectory

RNG = np.random.default_rng(0)
P = 16
STATS = stats(2, baseline=None, mean_policy_success=None, success_rate=None)
HEAD = {"run": "run-1", "incarnation": "ab12", "round": 7}
SHAPES = {
    "bodies": (3, 7),
    "actions": (2,),
    "terms": (2,),
    "channels/force": (3,),
    "channels/images": (2, 3, 4),
}


def trajectory(frames: int = 4, **changes: Any) -> Trajectory:
    values: dict[str, Any] = {
        "times": np.arange(frames) * 0.1,
        "bodies": RNG.normal(size=(frames, 3, 7)),
        "actions": RNG.normal(size=(frames, 2)),
        "terms": RNG.normal(size=(frames, 2)),
        "channels": {
            "force": RNG.normal(size=(frames, 3)),
            "images": RNG.normal(size=(frames, 2, 3, 4)),
        },
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
STATISTICS = report(STATS, incarnation="i", rate=300.0)
TRACE = np.zeros((15, 6), "<f4")
REPORT = dataclasses.replace(
    STATISTICS,
    lines=(Line(level="INFO", text="worker w joined"),),
    sample=WIRE,
    traces={"best": TRACE, "all": np.repeat(TRACE[None], 4, axis=0)},
)
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
                worker="host/a1",
                host="h",
                cores=2,
                version="0",
                fingerprint="c",
                rollouts=9,
                rate=0.9,
                seen=0.1,
            ),
        ),
    ),
    "request": WorkRequest(
        worker="host/a1", credits=64, idle=(), version="0.1.0", fingerprint="c", host="h", cores=2
    ),
    "request for nothing": WorkRequest(
        worker="host/a1",
        credits=0,
        idle=("run-1", "second"),
        version="",
        fingerprint="c",
        host="h",
        cores=2,
    ),
    "spec": Spec(
        run="run-1",
        task="pole.py:Pole",
        task_config={"width": 0.5, "steps": 15, "perturb": False},
        policy="direct",
        policy_config={"features": 5},
        code={"task": "0f", "policy": "1e", "simulation": "2d"},
        release="",
        files={"model.xml": "<mujoco/>" * 1000},
        constants={"frequencies": RNG.normal(size=(5, 8)), "phases": RNG.uniform(size=5)},
    ),
    "spec of a package": Spec(
        run="r",
        task="gym:Swimmer-v5",
        task_config={},
        policy="kernel",
        policy_config={},
        code={},
        release="a 1",
        policy_release="b 2",
        task_release="gymnasium 1.4",
    ),
    "round": RoundHeader(**HEAD, generation=6, spec="0f" * 32, traces="all", mu=RNG.normal(size=P)),
    "normalised round": RoundHeader(
        **HEAD,
        generation=6,
        spec="0f",
        traces="all",
        mu=np.zeros(2),
        normaliser=RNG.uniform(0.1, 1.0, (2, 2, 3)),
    ),
    "chunk": Chunk.carrying(JOBS, **HEAD),
    "chunk of means": Chunk.carrying(JOBS.take([3]), **HEAD),
    "results": Results(
        **HEAD,
        worker="host/a1",
        jobs=np.array([0, 3, 9]),
        returns=RNG.normal(size=5),
        flags=RNG.random((5, 4)) < 0.5,
        steps=np.arange(1, 6),
        traces=RNG.exponential(size=(4, 15, 6)).astype("<f4"),
        trajectories=(WIRE,),
    ),
    "results of one": Results(
        **HEAD,
        worker="w/1",
        jobs=np.array([4]),
        returns=np.zeros(1),
        flags=np.zeros((1, 4), bool),
        steps=np.ones(1, "<i8"),
        traces=np.empty((0, 15, 0), "<f4"),
        trajectories=(),
    ),
    "results with moments": Results(
        **HEAD,
        worker="w/1",
        jobs=np.array([4]),
        returns=np.zeros(2),
        flags=np.zeros((2, 4), bool),
        steps=np.ones(2, "<i8"),
        traces=np.empty((0, 15, 0), "<f4"),
        trajectories=(),
        moments=RNG.uniform(size=(2, 7)),
    ),
    "failure": Failure(**HEAD, worker="host/a1", index=3, error="ValueError: so it went"),
    "failure of a class from a file": Failure(
        **HEAD,
        worker="host/a1",
        index=3,
        error="ValueError: so",
        traceback=('  File "a.py", line 3', "ValueError: so"),
    ),
    "failure of all": Failure(**HEAD, worker="host/a1", index=None, error="not served"),
    "report": REPORT,
    "report of statistics": STATISTICS,
    "history": RunHistory(
        run="r",
        incarnation="i",
        recording="first",
        config={"seed": 0},
        files={"model.xml": "<mujoco/>"},
        generation=2,
        reports=(REPORT, REPORT),
        end=RunEnd(
            summary={"state": "finished"}, lines=(), best=None, best_generation=2, mean=None
        ),
    ),
    "history of nothing": RunHistory(
        run="r",
        incarnation="i",
        recording="r",
        config={},
        files={},
        generation=0,
        reports=(),
        end=None,
    ),
    "trajectory": WIRE,
    "trajectory of one frame": trajectory(frames=1, success=None, channels={}),
}
