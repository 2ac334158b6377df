"""What a child of a test's program does with pools; a module that a spawned child can import."""

import multiprocessing

import numpy as np

import farm
from farm.errors import RunError


def returns() -> list[float]:
    with farm.Farm("finger-gait", policy="constant", workers=1) as pool:
        values: list[float] = pool.map(np.zeros((2, pool.size))).tolist()
        return values


def tried(queue: "multiprocessing.Queue[object]", pool: farm.Farm | None) -> None:
    """Use a pool of one's own, or the given one."""
    try:
        queue.put(returns() if pool is None else pool.map(np.zeros((2, pool.size))).tolist())
    except RunError as error:
        queue.put(str(error))
    if pool is not None:
        pool.close()
