"""Files of LeRobot's data set format, against the published schema of version 3.0."""

import json
from pathlib import Path

import numpy as np
import pytest

from farm.sim.channels import Channel
from farm.tasks.base import TaskSpec
from farm.tasks.rollouts import steps_shape
from learner import parquet
from learner.tools.dataset.lerobot import Episode, Format

pyarrow = pytest.importorskip("pyarrow.parquet")

SPEC = TaskSpec(
    observation=3,
    action=1,
    steps=5,
    period=0.02,
    success=True,
    channels=(
        Channel(name="a/b", kind="scalars", shape=(2,), labels=("x", "y")),
        Channel(name="seen", kind="images", shape=(1, 2, 2)),
    ),
)
INFO = {
    "codebase_version": str,
    "robot_type": str,
    "total_episodes": int,
    "total_frames": int,
    "total_tasks": int,
    "chunks_size": int,
    "data_files_size_in_mb": int,
    "video_files_size_in_mb": int,
    "fps": int,
    "control_period": float,
    "splits": dict,
    "data_path": str,
    "video_path": type(None),
    "features": dict,
}
"""Fields of meta/info.json."""
DEFAULT = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that each data set has."""
EPISODES = (
    "episode_index",
    "tasks",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
    "meta/episodes/chunk_index",
    "meta/episodes/file_index",
)


@pytest.fixture
def data(tmp_path: Path) -> Format:
    """Two parts, of two episodes and of one."""
    rng, data_set = np.random.default_rng(0), Format(tmp_path, SPEC, "pole.py:Pole")
    episodes = [
        Episode(
            (4, 1, i, 0),
            rng.normal(size=(i + 2, steps_shape(SPEC)[1])).astype("<f4"),
            float(i),
            i == 1,
            False,
        )
        for i in range(3)
    ]
    data_set.write(0, 0, 0, episodes[:2])
    data_set.write(1, 2, 5, episodes[2:])
    data_set.finish(2)
    return data_set


def test_info_has_the_fields_of_the_schema(data: Format) -> None:
    info = json.loads((data.path / "meta/info.json").read_text())
    assert {name: type(value) for name, value in info.items()} == INFO
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == (
        "v3.0",
        3,
        9,
    )
    assert (info["fps"], info["control_period"]) == (50, data.spec.period)
    assert info["splits"] == {"train": "0:3"}
    assert not any("/" in name for name in info["features"])
    assert info["data_path"].format(chunk_index=0, file_index=1) == str(
        data.data(1).relative_to(data.path)
    )
    assert {name: info["features"][name]["dtype"] for name in DEFAULT} == DEFAULT
    assert info["features"]["next.a.b"] == {"dtype": "float32", "shape": [2], "names": ["x", "y"]}


def test_the_columns_have_the_types_and_shapes_of_the_features(data: Format) -> None:
    features = json.loads((data.path / "meta/info.json").read_text())["features"]
    for part in (0, 1):
        table = pyarrow.read_table(data.data(part))
        assert table.column_names == list(features)
        for name, each in features.items():
            kind, shape = table.schema.field(name).type, each["shape"]
            for size in shape if shape != [1] else ():  # a column of one number holds no lists
                assert not hasattr(kind, "list_size") or kind.list_size == size
                kind = kind.value_type
            assert (
                str(kind) == {"float32": "float", "bool": "bool", "int64": "int64"}[each["dtype"]]
            )
            assert np.array(table[name].to_pylist()).shape[1:] == (
                tuple(shape) if shape != [1] else ()
            )
    assert pyarrow.read_table(data.path / "data").num_rows == 9, "all files together are one table"


def test_times_and_numbers_count_as_the_format_wants(data: Format) -> None:
    rows = [parquet.read(data.data(part), list(DEFAULT)) for part in (0, 1)]
    columns = {name: [*rows[0][name], *rows[1][name]] for name in DEFAULT}
    assert columns["index"] == list(range(9))
    assert columns["episode_index"] == [0] * 2 + [1] * 3 + [2] * 4
    assert columns["frame_index"] == [0, 1, 0, 1, 2, 0, 1, 2, 3]
    np.testing.assert_allclose(
        columns["timestamp"], np.array(columns["frame_index"]) / 50, rtol=1e-6
    )


def test_episodes_say_where_they_are(data: Format) -> None:
    for part, first in ((0, 0), (1, 2)):
        table = pyarrow.read_table(data.episodes(part))
        assert table.column_names[: len(EPISODES)] == list(EPISODES)
        rows = table.select(EPISODES).to_pylist()
        assert [row["episode_index"] for row in rows] == list(range(first, first + len(rows)))
        assert all(
            row["dataset_to_index"] - row["dataset_from_index"] == row["length"] for row in rows
        )
        assert all((row["data/chunk_index"], row["data/file_index"]) == (0, part) for row in rows)
        assert rows[0]["tasks"] == ["pole.py:Pole"]


def test_statistics_are_those_of_all_rows(data: Format) -> None:
    stats = json.loads((data.path / "meta/stats.json").read_text())
    for name in json.loads((data.path / "meta/info.json").read_text())["features"]:
        values = np.array(
            [row for part in (0, 1) for row in parquet.read(data.data(part), [name])[name]],
            dtype=float,
        )
        values = values[:, None] if values.ndim == 1 else values
        column = stats[name]
        assert column["count"] == [9]
        for each in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(
                column[each], getattr(values, each)(axis=0), rtol=1e-12, atol=1e-12
            )


def test_pandas_finds_the_task_as_the_index(data: Format) -> None:
    pandas = pytest.importorskip("pandas")
    tasks = pandas.read_parquet(data.path / "meta/tasks.parquet")
    assert (tasks.iloc[0].name, tasks.index.name, tasks["task_index"].tolist()) == (
        "pole.py:Pole",
        "task",
        [0],
    )
