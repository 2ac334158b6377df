"""EvoTorch's PGPE searches the finger gait on a pool of workers.

    python examples/evotorch_search.py

It needs evotorch: pip install evotorch.
"""

import sys

import farm

try:
    import torch
    from evotorch import Problem
    from evotorch.algorithms import PGPE
except ImportError:
    sys.exit("this example needs evotorch: pip install evotorch")


if __name__ == "__main__":
    with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
        problem = Problem(
            "max",
            lambda batch: torch.as_tensor(pool.map(batch.numpy())),
            vectorized=True,
            seed=0,
            solution_length=pool.size,
            initial_bounds=(1.5, 1.5),
            dtype=torch.float64,
        )
        search = PGPE(
            problem, popsize=20, center_learning_rate=0.3, stdev_learning_rate=0.1, stdev_init=0.3
        )
        for generation in range(10):
            search.step()
            print(f"generation {generation}: mean return {search.status['mean_eval']:.3f}")
