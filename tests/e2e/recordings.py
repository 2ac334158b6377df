"""Reads recordings with Rerun's own reader."""

import warnings
from collections import defaultdict
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

_TIMES = ("generation", "sim_time", "wall_time")


def read(path: Path) -> dict[str, list[Any]]:
    """Record batches by entity."""
    batches: dict[str, list[Any]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batches[chunk.entity_path].append(chunk.to_record_batch())
    return batches


def rows(batches: list[Any], name: str) -> dict[int, Any]:
    """A column's values by generation."""
    by_generation: dict[int, Any] = {}
    for batch in batches:
        columns = [n for n in batch.schema.names if n == name or n.endswith(f":{name}")]
        if columns and "generation" in batch.schema.names:
            values = batch.column(columns[0]).to_pylist()
            generations = batch.column("generation").cast("int64").to_pylist()
            for generation, value in zip(generations, values, strict=True):
                if value is not None:
                    assert generation not in by_generation, "a generation is recorded twice"
                    by_generation[generation] = value
    return by_generation


def texts(path: Path, entity: str) -> list[str]:
    """Every text of an entity, in order."""
    out: list[str] = []
    for batch in read(path)[entity]:
        (name,) = [n for n in batch.schema.names if n.endswith(":text")]
        out += [text for row in batch.column(name).to_pylist() for text in row or []]
    return out


def generations(path: Path) -> list[int]:
    """The generations in a recording, each once."""
    return sorted(rows(read(path)["/learning/return"], "scalars"))


def has_generation(path: Path) -> bool:
    """Whether a file that is still being written has a generation; its last message may be
    incomplete.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Rerun warns of a file without an end
        try:
            return bool(generations(path))
        except AssertionError:
            raise
        except Exception:  # Rerun's reader raises many types
            return False


def content(path: Path) -> dict[tuple[Any, ...], list[Any]]:
    """Every value of a recording but the time of day, by entity, column, generation and time in the
    simulation.
    """
    values: dict[tuple[Any, ...], list[Any]] = defaultdict(list)
    for entity, batches in read(path).items():
        for batch in (b for b in batches if "generation" in b.schema.names):
            at = [batch.column(name).cast("int64").to_pylist() for name in _TIMES[:2]]
            for name in (n for n in batch.schema.names if n not in _TIMES and "RowId" not in n):
                for generation, time, value in zip(
                    *at, batch.column(name).to_pylist(), strict=True
                ):
                    if value is not None:
                        values[entity, name, generation, time].append(value)
    return values
