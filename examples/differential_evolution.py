"""scipy's differential evolution searches the finger gait's kernel centres on a pool of workers.

    python examples/differential_evolution.py

It needs scipy: pip install -c constraints.txt '.[search]'.
"""

import sys

import farm

try:
    from scipy.optimize import differential_evolution
except ImportError:
    sys.exit("this example needs scipy: pip install -c constraints.txt '.[search]'")

if __name__ == "__main__":
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        result = differential_evolution(
            lambda x: -pool.map(x.T),
            [(0.0, 3.0)] * pool.size,
            vectorized=True,
            updating="deferred",
            maxiter=5,
            popsize=1,
            polish=False,
            rng=0,
        )
    print(f"return {-result.fun:.3f} after {result.nfev} calls of the pool")
