"""Series of trials as an experiment of benchmarks/thesis has them, without runs."""

import numpy as np

from benchmarks.thesis.series import COLUMNS, Series


def made(returns: np.ndarray, success: np.ndarray | None = None, **changes: object) -> Series:
    """A series of these returns, (trials, generations)."""
    count = len(returns)
    columns = {name: returns.astype(float) for name in COLUMNS}
    columns["mean_policy_success"] = (
        np.zeros_like(returns) if success is None else success.astype(float)
    )
    values = {
        "columns": columns,
        "states": ("finished",) * count,
        "robust": np.ones(count),
        "succeeded": columns["mean_policy_success"][:, -1] > 0,
        "final": returns[:, -1].astype(float),
        "rollouts": 30,
        "seconds": np.ones(count),
        "hashes": ("",) * count,
    }
    return Series(**{**values, **changes})  # type: ignore[arg-type]


def rising(at: int, to: float, length: int = 150, trials: int = 5) -> np.ndarray:
    """Returns that go from -100 to another value at a generation."""
    return np.tile(np.where(np.arange(1, length + 1) < at, -100.0, to), (trials, 1))
