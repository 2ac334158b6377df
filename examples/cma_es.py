"""CMA-ES of the package cmaes searches the finger gait on a pool of workers.

    python examples/cma_es.py

It needs cmaes: pip install -c constraints.txt '.[cma]'.
"""

import sys

import numpy as np

import farm

try:
    from cmaes import CMA
except ImportError:
    sys.exit("this example needs cmaes: pip install -c constraints.txt '.[cma]'")

if __name__ == "__main__":
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        search = CMA(mean=np.full(pool.size, 1.5), sigma=0.3, seed=0, population_size=20)
        for generation in range(10):
            thetas = [search.ask() for _ in range(20)]
            returns = pool.map(thetas, seeds=range(20 * generation, 20 * generation + 20))
            search.tell(list(zip(thetas, -returns, strict=True)))
            print(f"generation {generation}: best return {returns.max():.3f}")
