"""NSGA-II of the package pymoo finds grips with two objectives and a constraint, on a pool of
workers.

    python examples/nsga2.py

The object should move little, and the joints should move little, while the middle finger carries at
least a tenth of the force. It needs pymoo: pip install -c constraints.txt '.[search]'.
"""

import sys
from pathlib import Path

import numpy as np

import farm

try:
    from pymoo.algorithms.moo.nsga2 import NSGA2
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize
except ImportError:
    sys.exit("this example needs pymoo: pip install -c constraints.txt '.[search]'")

TASK = f"{Path(__file__).parent / 'tasks/grips.py'}:Grips"
LEAST = 0.1
"""Share of the force that the middle finger must carry."""


class Grip(Problem):
    """Parameters of a constant policy, the offsets of eight joint targets [rad]."""

    def __init__(self, pool: farm.Farm) -> None:
        super().__init__(n_var=pool.size, n_obj=2, n_ieq_constr=1, xl=-0.5, xu=0.5)
        self.pool = pool

    def _evaluate(
        self, thetas: np.ndarray, out: dict[str, np.ndarray], *_: object, **__: object
    ) -> None:
        middle, shift = self.pool.evaluate(thetas).measures.T  # nominal starts
        out["F"] = np.stack([1e3 * shift, np.abs(thetas).max(axis=1)], axis=1)
        out["G"] = LEAST - middle[:, None]  # at most 0


if __name__ == "__main__":
    with farm.Farm(TASK, policy="constant", workers=2) as pool:
        result = minimize(Grip(pool), NSGA2(pop_size=40), ("n_gen", 20), seed=0)
    if result.F is None:
        sys.exit("no grip fulfils the constraint")
    for shift, offset in result.F[np.argsort(result.F[:, 0])]:
        print(f"shift {shift:.2f} mm, largest offset {offset:.3f} rad")
    print(
        f"{len(result.F)} grips, none better than another in both; the middle finger carries"
        f" {LEAST:.0%} or more"
    )
