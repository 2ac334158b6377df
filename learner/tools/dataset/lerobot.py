"""Episodes as files of LeRobot's data set format, version 3.0
(https://huggingface.co/docs/lerobot).

    data/chunk-000/file-000.parquet            a row per control step
    meta/episodes/chunk-000/file-000.parquet   a row per episode of that file, with its statistics
    meta/tasks.parquet, meta/stats.json, meta/info.json   written at the end

What is known before a step's physics is `observation.state` and `action`; names that begin with
`next.` come after it.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, FloatArray
from farm.errors import writing
from farm.tasks.base import TaskSpec
from farm.tasks.rollouts import step_shapes
from learner import parquet
from learner.run.files import replace_text

_FILES: Final = 1000  # of a folder
_STATISTICS: Final = ("min", "max", "mean", "std", "count")
_COUNTERS: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


@dataclass(frozen=True)
class Episode:
    """One episode of T control steps."""

    seed: tuple[int, ...]
    steps: AnyArray
    """Trace of the episode, of kind `steps`, (T, N), float32"""
    value: float
    """The return; nan if it failed."""
    success: bool
    failed: bool
    """Whether the simulation of the episode became unstable."""


@dataclass(frozen=True)
class Format:
    """The files of a data set in a folder."""

    path: Path
    spec: TaskSpec
    task: str
    """What the task is called."""

    @property
    def rate(self) -> int:
        """Control steps per second, in whole numbers as the format has them: what timestamps count.

        The exact time of a control step is the field `control_period` of info.json.
        """
        return max(1, round(1.0 / self.spec.period))

    def data(self, part: int) -> Path:
        """The file of a part's steps."""
        return self.path / f"data/chunk-{part // _FILES:03d}/file-{part % _FILES:03d}.parquet"

    def episodes(self, part: int) -> Path:
        """The file of a part's episodes."""
        return (
            self.path / f"meta/episodes/chunk-{part // _FILES:03d}/file-{part % _FILES:03d}.parquet"
        )

    def write(self, part: int, first: int, frames: int, episodes: Sequence[Episode]) -> str:
        """Write a part's two files.

        Args:
          part: its number.
          first: number of its first episode.
          frames: number of control steps before it.
          episodes: its own.

        Returns:
          SHA-256 of its numbers.

        Raises:
          RunError: it cannot be written.
        """
        lengths = np.array([len(each.steps) for each in episodes])
        starts = frames + np.cumsum(lengths) - lengths
        tables = [self._steps(first + i, int(starts[i]), each) for i, each in enumerate(episodes)]
        count, statistics = len(episodes), [_statistics(table) for table in tables]
        folder, file = np.full(count, part // _FILES), np.full(count, part % _FILES)
        rows: dict[str, Any] = {
            "episode_index": first + np.arange(count),
            "tasks": ("texts", [[self.task]] * count),
            "length": lengths,
            "dataset_from_index": starts,
            "dataset_to_index": starts + lengths,
            "data/chunk_index": folder,
            "data/file_index": file,
            "meta/episodes/chunk_index": folder,
            "meta/episodes/file_index": file,
            "return": np.array([each.value for each in episodes]),
            "failed": np.array([each.failed for each in episodes]),
            "seed": np.array([each.seed for each in episodes]),
        }
        if self.spec.success:
            rows["success"] = np.array([each.success for each in episodes])
        for name in tables[0]:
            for each in _STATISTICS:
                rows[f"stats/{name}/{each}"] = np.stack([of[name][each] for of in statistics])
        parquet.write(
            self.data(part),
            {name: np.concatenate([table[name] for table in tables]) for name in tables[0]},
        )
        parquet.write(self.episodes(part), rows)
        hashed = hashlib.sha256()
        for each in episodes:
            hashed.update(
                np.array([len(each.steps), *each.seed], dtype="<i8").tobytes()
                + each.steps.tobytes()
            )
        return hashed.hexdigest()

    def finish(self, parts: int) -> None:
        """Write what is known of all episodes, from the files of all parts.

        Raises:
          RunError: it cannot be written.
        """
        total: dict[str, dict[str, FloatArray]] = {}
        episodes = 0
        for part in range(parts):
            columns = parquet.read(
                self.episodes(part),
                ["length", *(f"stats/{n}/{s}" for n in self.features for s in _STATISTICS)],
            )
            episodes += len(columns["length"])
            for name in self.features:
                rows = {
                    each: np.array(columns[f"stats/{name}/{each}"], dtype=float)
                    for each in _STATISTICS
                }
                table = (
                    {each: values[None] for each, values in total[name].items()}
                    if name in total
                    else None
                )
                total[name] = _joined(
                    rows
                    if table is None
                    else {k: np.concatenate([table[k], rows[k]]) for k in rows}
                )
        frames = int(total["index"]["count"][0])
        stats = {
            name: {each: values.tolist() for each, values in table.items()}
            for name, table in total.items()
        }
        for column in stats.values():
            column["count"] = [frames]
        tasks = {"task_index": np.zeros(1, dtype=np.int64), "task": ("text", [self.task])}
        parquet.write(self.path / "meta/tasks.parquet", tasks, index="task")
        info = {
            "codebase_version": "v3.0",
            "robot_type": self.task,
            "total_episodes": episodes,
            "total_frames": frames,
            "total_tasks": 1,
            "chunks_size": _FILES,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.rate,
            "control_period": self.spec.period,
            "splits": {"train": f"0:{episodes}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": self.features,
        }
        for name, table in {"stats": stats, "info": info}.items():
            with writing(self.path / f"meta/{name}.json"):
                replace_text(self.path / f"meta/{name}.json", json.dumps(table, indent=2) + "\n")

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """Type, shape and names of each column of the steps."""
        spec, shapes = self.spec, step_shapes(self.spec)
        columns: dict[str, dict[str, Any]] = {
            "observation.state": _feature("float32", shapes["observation"]),
            "action": _feature("float32", shapes["action"]),
            "next.reward": _feature("float32", (1,)),
            "next.done": _feature("bool", (1,)),
        }
        if spec.success:
            columns["next.success"] = _feature("bool", (1,))
        if len(spec.terms) > 1:
            columns["next.reward_terms"] = _feature("float32", shapes["terms"], spec.terms)
        for channel in spec.channels:
            names = channel.names if len(channel.shape) == 1 else None
            columns[_column(channel.name)] = _feature("float32", channel.shape, names)
        return columns | {name: _feature(kind, (1,)) for name, kind in _COUNTERS.items()}

    def _steps(self, number: int, start: int, episode: Episode) -> dict[str, AnyArray]:
        """An episode's rows by column, (T,) or (T, ...)."""
        spec, count, at = self.spec, len(episode.steps), 0
        parts: dict[str, AnyArray] = {}
        for name, shape in step_shapes(spec).items():
            size = int(np.prod(shape))
            values = episode.steps[:, at : at + size].reshape(count, *shape)
            parts[name] = values[:, 0] if shape == (1,) else values
            at += size
        last = np.arange(count) == count - 1
        terms = parts["terms"].reshape(count, -1)
        frames = np.arange(count)
        columns: dict[str, AnyArray] = {
            "observation.state": parts["observation"],
            "action": parts["action"],
            "next.reward": terms.sum(axis=1, dtype=float).astype("<f4"),
            "next.done": last,
            "next.success": last & episode.success,
            "next.reward_terms": terms,
            **{_column(each.name): parts[f"channels/{each.name}"] for each in spec.channels},
            "timestamp": (frames / self.rate).astype("<f4"),
            "frame_index": frames,
            "episode_index": np.full(count, number),
            "index": start + frames,
            "task_index": np.zeros(count, np.int64),
        }
        return {name: columns[name] for name in self.features}


def _column(channel: str) -> str:
    """The column of a channel; names of columns have no slash."""
    return f"next.{channel.replace('/', '.')}"


def _feature(kind: str, shape: Sequence[int], names: Sequence[str] | None = None) -> dict[str, Any]:
    return {"dtype": kind, "shape": list(shape), "names": None if names is None else list(names)}


def _statistics(table: Mapping[str, AnyArray]) -> dict[str, dict[str, AnyArray]]:
    """Statistics of each column over an episode, (1,) or of the shape of its rows."""
    statistics = {}
    for name, column in table.items():
        values = column.astype(float)
        values = values[:, None] if values.ndim == 1 else values
        statistics[name] = {
            "min": values.min(axis=0),
            "max": values.max(axis=0),
            "mean": values.mean(axis=0),
            "std": values.std(axis=0),
            "count": np.array([len(values)]),
        }
    return statistics


def _joined(rows: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Statistics of several parts, one in each row, put together."""
    count = rows["count"].reshape(-1, *[1] * (rows["mean"].ndim - 1))
    total = count.sum(axis=0)
    mean = (count * rows["mean"]).sum(axis=0) / total
    square = (count * (rows["std"] ** 2 + (rows["mean"] - mean) ** 2)).sum(axis=0) / total
    return {
        "min": rows["min"].min(axis=0),
        "max": rows["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(square),
        "count": rows["count"].sum(axis=0),
    }
