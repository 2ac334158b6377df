"""pycma searches the finger gait on a pool of workers.

    python examples/pycma.py

It needs cma: pip install -c constraints.txt '.[search]'.
"""

import sys

import farm

try:
    import cma
except ImportError:
    sys.exit("this example needs cma: pip install -c constraints.txt '.[search]'")

if __name__ == "__main__":
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        search = cma.CMAEvolutionStrategy(
            [1.5] * pool.size, 0.3, {"popsize": 20, "seed": 1, "verbose": -9}
        )
        for generation in range(10):
            thetas = search.ask()
            returns = pool.map(thetas, seeds=range(20 * generation, 20 * generation + 20))
            search.tell(thetas, -returns)
            print(f"generation {generation}: best return {returns.max():.3f}")
