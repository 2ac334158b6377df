"""Nevergrad's CMA searches the finger gait on a pool of workers.

    python examples/nevergrad_search.py

It needs nevergrad: pip install nevergrad.
"""

import sys

import numpy as np

import farm

try:
    import nevergrad
except ImportError:
    sys.exit("this example needs nevergrad: pip install nevergrad")

if __name__ == "__main__":
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        space = nevergrad.p.Array(init=np.full(pool.size, 1.5)).set_mutation(sigma=0.3)
        space.random_state.seed(0)
        search = nevergrad.optimizers.CMA(space, budget=200, num_workers=20)
        for generation in range(10):
            candidates = [search.ask() for _ in range(20)]
            returns = pool.map(
                [each.value for each in candidates],
                seeds=range(20 * generation, 20 * generation + 20),
            )
            for each, value in zip(candidates, returns, strict=True):
                search.tell(each, -value)
            print(f"generation {generation}: best return {returns.max():.3f}")
