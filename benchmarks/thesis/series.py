"""The records of a set-up's runs, as arrays and as one compact file.

Figures and findings need only these files, so they can be remade without the runs.
"""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError, RunError
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

COLUMNS: Final = (
    "return_mean",
    "mean_policy_return",
    "mean_policy_success",
    "success_rate",
    "sigma_mean",
    "mu_2",
    "sigma_2",
)
"""Quantities per generation: fields of progress.jsonl, and mu and sigma of the second parameter
(figure 4.2).
"""

LEARNT: Final = 0.8
"""Robust success from which a run counts as learnt, if its last mean policy succeeds as well."""

END: Final = 10
"""Number of generations that count as the end of a run."""

_SECOND: Final = 1
_MOST: Final = 3e38


@dataclass(frozen=True)
class Series:
    """The trials of a set-up."""

    columns: Mapping[str, FloatArray]
    """COLUMNS by name, (trials, generations); nan after a trial's end."""
    states: tuple[str, ...]
    """How each trial ended: finished, diverged, failed, interrupted; unfinished, missing."""
    robust: FloatArray
    """(trials,) robust success of the final mean policy, nan if it was not evaluated."""
    succeeded: BoolArray
    """(trials,) whether the final mean policy succeeded on the nominal start."""
    final: FloatArray
    """(trials,) return of the final mean policy, nan if it was not evaluated."""
    rollouts: int
    """Exploring rollouts per generation."""
    seconds: FloatArray
    """(trials,) wall time of each run [s]."""
    hashes: tuple[str, ...]
    """parameters_sha256 of each trial, empty if there is none."""

    @property
    def trials(self) -> int:
        """Number of trials."""
        return len(self.states)

    @property
    def empty(self) -> bool:
        """Whether no trial has recorded anything."""
        return bool(np.isnan(self.columns["return_mean"]).all())

    @property
    def learnt(self) -> BoolArray:
        """(trials,) whether the gait was learnt: the final mean policy succeeds, and robustly."""
        return self.succeeded & (self.robust >= LEARNT)

    @property
    def since(self) -> FloatArray:
        """(trials,) the generation from which every mean policy succeeds to the end, nan if there
        is none.
        """
        good = np.nan_to_num(self.columns["mean_policy_success"]) > 0
        ran = ~np.isnan(self.columns["return_mean"])
        out = np.full(self.trials, np.nan)
        for trial in np.flatnonzero(self.succeeded):
            row = good[trial, : int(ran[trial].sum())]
            bad = np.flatnonzero(~row)
            out[trial] = 1 + (bad[-1] + 1 if len(bad) else 0)
        return out

    def end(self, column: str) -> FloatArray:
        """(trials,) mean of a column over its last END generations that ran."""
        out = np.full(self.trials, np.nan)
        for trial, row in enumerate(self.columns[column]):
            last = row[~np.isnan(row)][-END:]
            if len(last):
                out[trial] = last.mean()
        return out

    def failures(self) -> list[str]:
        """Text for each trial that did not finish."""
        return [f"trial {i} {state}" for i, state in enumerate(self.states) if state != "finished"]


def known_mean(values: FloatArray, axis: int) -> FloatArray:
    """Mean over an axis, ignoring nan; nan if there is nothing else."""
    count = (~np.isnan(values)).sum(axis=axis)
    return np.where(count > 0, np.nansum(values, axis=axis) / np.maximum(count, 1), np.nan)


def read(folders: Sequence[RunFolder], config: RunConfig) -> Series:
    """The series of runs, one folder per trial; missing or broken runs get that state."""
    runs = [_run(folder) for folder in folders]
    generations = max(
        [config.generations, *(len(columns["return_mean"]) for columns, _, _ in runs)]
    )
    columns = {
        name: np.stack([_padded(progress[name], generations) for progress, _, _ in runs])
        for name in COLUMNS
    }
    summaries = [summary for _, summary, _ in runs]
    return Series(
        columns=columns,
        states=tuple(_state(progress, summary) for progress, summary, _ in runs),
        robust=_numbers(summaries, "robust_success_rate"),
        succeeded=np.array([bool(summary.get("mean_policy_success")) for summary in summaries]),
        final=_numbers(summaries, "mean_policy_return"),
        rollouts=max(first for _, _, first in runs),
        seconds=_numbers(summaries, "seconds"),
        hashes=tuple(summary.get("parameters_sha256") or "" for summary in summaries),
    )


def save(path: Path, series: Series) -> None:
    """Write a series to an .npz file."""
    rest = {
        "states": np.array(series.states),
        "robust": series.robust,
        "succeeded": series.succeeded,
        "final": series.final,
        "rollouts": np.array(series.rollouts),
        "seconds": series.seconds,
        "hashes": np.array(series.hashes),
    }
    # Single precision is enough for figures.
    columns = {
        name: np.clip(values, -_MOST, _MOST).astype("<f4")
        for name, values in series.columns.items()
    }
    write_arrays(path, {**columns, **rest})


def load(path: Path) -> Series:
    """Read a series back.

    Raises:
      ConfigError: the file is missing or is not one.
    """
    file = read_arrays(path)
    try:
        return Series(
            columns={name: file[name].astype(float) for name in COLUMNS},
            states=tuple(file["states"].tolist()),
            robust=file["robust"],
            succeeded=file["succeeded"],
            final=file["final"],
            rollouts=int(file["rollouts"]),
            seconds=file["seconds"],
            hashes=tuple(file["hashes"].tolist()),
        )
    except KeyError as error:
        raise ConfigError(f"{path} is not a series of this release: {error.args[0]}") from None


def write_arrays(path: Path, arrays: Mapping[str, "np.ndarray[Any, Any]"]) -> None:
    """Write an .npz file atomically.

    Raises:
      RunError: it cannot be written.
    """
    aside = path.with_name(path.name + ".new")
    try:
        with aside.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        aside.replace(path)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from None


def read_arrays(path: Path) -> dict[str, "np.ndarray[Any, Any]"]:
    """The arrays of an .npz file.

    Raises:
      ConfigError: it is missing or is not one.
    """
    try:
        with path.open("rb") as binary, np.load(binary, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, TypeError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise ConfigError(f"cannot read {path}: {error}") from None


def _run(folder: RunFolder) -> tuple[dict[str, FloatArray], dict[str, Any], int]:
    """Columns and summary of one run, and its rollouts per generation."""
    progress = folder.progress()
    columns = {
        name: np.array(
            [np.nan if (v := getattr(p, name)) is None else v for p in progress], dtype=float
        )
        for name in COLUMNS[:5]
    }
    for name in ("mu_2", "sigma_2"):
        columns[name] = np.full(len(progress), np.nan)
    if progress and (folder.path / "parameters").exists():  # it comes right after the first line
        rows = folder.parameters.rows()
        rows = rows[rows["generation"] <= len(progress)]
        for name in ("mu", "sigma"):
            columns[f"{name}_2"][rows["generation"] - 1] = rows[name][
                :, min(_SECOND, rows[name].shape[1] - 1)
            ]
    return columns, folder.read_summary() or {}, progress[0].rollouts if progress else 0


def _state(columns: dict[str, FloatArray], summary: dict[str, Any]) -> str:
    return summary.get("state") or ("unfinished" if len(columns["return_mean"]) else "missing")


def _padded(values: FloatArray, length: int) -> FloatArray:
    return np.concatenate([values, np.full(length - len(values), np.nan)])


def _numbers(summaries: Sequence[dict[str, Any]], name: str) -> FloatArray:
    return np.array(
        [np.nan if summary.get(name) is None else summary[name] for summary in summaries],
        dtype=float,
    )
