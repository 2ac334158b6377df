"""A test task with a channel of each kind, one without channels, and Rerun's own reader for
recordings.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from farm.arrays import AnyArray
from farm.sim.channels import flat
from farm.sim.model_files import compiled
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.base import Channel, TaskSpec
from learner.recording.drawing import Drawing
from learner.recording.recorder import Recorder

STEPS, PERIOD = 15, 0.1

MJCF = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="ball" pos="0 0 1"><freejoint/><geom name="ball" type="sphere" size="0.1"/></body>
    <body name="arm" pos="1 0 1" quat="0.8 0.6 0 0">
      <joint axis="0 1 0"/><geom name="arm" type="capsule" size="0.05" fromto="0 0 0.1 0 0 0.5"/>
    </body>
  </worldbody>
</mujoco>
"""
PLACES = np.stack([np.arange(18.0).reshape(6, 3) / 100, np.arange(18.0).reshape(6, 3) / 50])
CHANNELS = (
    Channel(
        name="touch/force",
        kind="scalars",
        shape=(2,),
        labels=("left", "right side"),
        unit="N",
        limits={"right side": (0.25, 1.5)},
    ),
    Channel(name="touch/state", kind="flags", shape=(2,), labels=("left", "right side")),
    Channel(
        name="pads",
        kind="images",
        shape=(2, 2, 3),
        labels=("left", "right side"),
        top=2.0,
        bodies=("ball", "arm"),
        places=PLACES,
        trace=True,
    ),
    Channel(
        name="touch/push",
        kind="arrows",
        shape=(2, 6),
        bodies=("ball", "arm"),
        length=0.5,
        longest=1.0,
    ),
    Channel(name="goals", kind="points", shape=(3, 4), top=4.0),
)


@pytest.fixture(scope="session")
def scene() -> Scene:
    return Scene(compiled(MJCF, "made up"))


@pytest.fixture(scope="session")
def scene_text() -> str:
    return MJCF


@pytest.fixture(scope="session")
def spec() -> TaskSpec:
    return TaskSpec(
        observation=8,
        action=2,
        steps=STEPS,
        period=PERIOD,
        terms=("reach", "cost"),
        success=True,
        channels=CHANNELS,
    )


@pytest.fixture(scope="session")
def plain() -> TaskSpec:
    return TaskSpec(observation=8, action=3, steps=STEPS, period=PERIOD)


@pytest.fixture
def start(tmp_path: Path, scene: Scene, spec: TaskSpec) -> Callable[..., Recorder]:
    """Begin a recorder of a run called `try`."""

    def begin(
        name: str = "run.rrd", done: int = 0, spec: TaskSpec = spec, *, ended: bool = False
    ) -> Recorder:
        return Recorder(
            tmp_path / name,
            run="try",
            drawing=Drawing(scene, spec),
            config="# settings",
            done=done,
            ended=ended,
        )

    return begin


@pytest.fixture
def rollout(scene: Scene, spec: TaskSpec) -> Callable[..., Trajectory]:
    """Make a rollout of the task; without touch in the first half of its frames."""

    def make(frames: int = STEPS + 1, step: float = PERIOD, spec: TaskSpec = spec) -> Trajectory:
        rng = np.random.default_rng(0)
        qpos = np.repeat(scene.model.qpos0[None], frames, axis=0) + rng.normal(size=(frames, 8))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        channels = {c.name: rng.uniform(0.1, 1.0, (frames, *c.shape)) for c in spec.channels}
        if channels:
            channels["touch/state"] = np.tile(np.arange(frames)[:, None] >= frames // 2, 2) * 1.0
            channels["touch/push"][: frames // 2, :, 3:] = 0.0
        return Trajectory.of(
            times=np.arange(frames) * step,
            bodies=scene.poses(qpos),
            actions=rng.normal(size=(frames, spec.action)),
            terms=rng.normal(size=(frames, len(spec.terms))),
            channels=channels,
            value=-3.25,
            success=True if spec.success else None,
        )

    return make


@pytest.fixture
def traces(
    rollout: Callable[..., Trajectory], spec: TaskSpec
) -> Callable[..., dict[str, AnyArray]]:
    def make(rollouts: int = 4) -> dict[str, AnyArray]:
        one = flat(spec.trace_channels, rollout().channels)[1:]
        every = np.stack([one + i for i in range(rollouts)]).astype("<f4")
        return {"best": every[0], "worst": every[-1], "all": every}

    return make


def _breaks(values: list[Any]) -> bool:
    return bool(values) and all(isinstance(value, float) and np.isnan(value) for value in values)


class Rows:
    """What a file holds, by entity."""

    def __init__(self, path: Path) -> None:
        self.batches: dict[str, list[Any]] = defaultdict(list)
        self.static: set[str] = set()
        for chunk in RrdReader(path).stream():
            self.batches[chunk.entity_path].append(chunk.to_record_batch())
            if chunk.is_static:
                self.static.add(chunk.entity_path)

    def column(self, entity: str, name: str) -> list[Any]:
        """Return a column's values in the order of sim_time, without the rows that break curves."""
        return [
            value
            for _, value in self._rows(entity, name)
            if np.ndim(value) != 1 or not _breaks(value)
        ]

    def breaks(self, entity: str) -> list[int]:
        """Return the sim_time [ns] at which an entity's curves are broken."""
        return [time for time, value in self._rows(entity, "scalars") if _breaks(value)]

    def _rows(self, entity: str, name: str) -> list[tuple[int, Any]]:
        rows = []
        for batch in self.batches[entity]:
            columns = [n for n in batch.schema.names if n == name or n.endswith(f":{name}")]
            if columns and "sim_time" in batch.schema.names:
                times = batch.column("sim_time").cast("int64").to_pylist()
                rows += zip(times, batch.column(columns[0]).to_pylist(), strict=True)
        return [row for row in sorted(rows, key=lambda row: row[0]) if row[1] is not None]

    def fixed(self, entity: str, name: str) -> Any:
        """Return a static value."""
        for batch in self.batches[entity]:
            for column in batch.schema.names:
                if column.endswith(f":{name}") and "sim_time" not in batch.schema.names:
                    return batch.column(column).to_pylist()[0]
        raise KeyError(name)

    def times(self, entity: str) -> list[int]:
        """Return an entity's sim_time [ns]."""
        timed = [b for b in self.batches[entity] if "sim_time" in b.schema.names]
        return sorted(t for b in timed for t in b.column("sim_time").cast("int64").to_pylist())


@pytest.fixture
def rows_of(tmp_path: Path) -> Callable[[str], Rows]:
    return lambda name="run.rrd": Rows(tmp_path / name)
