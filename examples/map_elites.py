"""MAP-Elites of the package pyribs fills an archive of grips, by two measures, on a pool.

    python examples/map_elites.py

writes archive.npz and archive.svg, a heat map. It needs pyribs and matplotlib:

    pip install -c constraints.txt '.[search,figures]'
"""

import sys
from pathlib import Path

import numpy as np

import farm

try:
    from matplotlib import pyplot as plt
    from ribs.archives import GridArchive
    from ribs.emitters import EvolutionStrategyEmitter
    from ribs.schedulers import Scheduler
except ImportError:
    sys.exit(
        "this example needs pyribs and matplotlib: pip install -c constraints.txt"
        " '.[search,figures]'"
    )

TASK = f"{Path(__file__).parent / 'tasks/grips.py'}:Grips"
GENERATIONS, BATCH = 40, 40

if __name__ == "__main__":
    with farm.Farm(TASK, policy="constant", workers=2) as pool:
        ranges = [(each.low, each.high) for each in pool.spec.measures]
        options = {
            "solution_dim": pool.size,
            "ranges": ranges,
            "learning_rate": 1.0,
            "threshold_min": -1e3,
        }
        archive = GridArchive(
            dims=(12, 12), seed=0, extra_fields={"seed": ((), np.int64)}, **options
        )
        kind = {"x0": np.zeros(pool.size), "sigma0": 0.15, "batch_size": BATCH, "seed": 0}
        search = Scheduler(archive, [EvolutionStrategyEmitter(archive, **kind)])
        for generation in range(GENERATIONS):
            thetas, seeds = search.ask(), np.arange(BATCH) + BATCH * generation
            results = pool.evaluate(thetas, seeds)
            search.tell(results.returns, results.measures, seed=seeds)
            if generation % 10 == 9:
                best = archive.stats.obj_max
                print(
                    f"generation {generation + 1}: {len(archive)} grips, the best returns"
                    f" {best:.3f}"
                )
        elites = archive.data()
        again = [
            pool.rollout(elites["solution"][i], int(elites["seed"][i])).value
            for i in range(0, len(archive), 10)
        ]
        same = np.array_equal(again, elites["objective"][::10])
    print(
        f"every tenth elite again from its seed: {'the same returns' if same else 'other returns'}"
    )
    np.savez(
        "archive.npz",
        **{name: elites[name] for name in ("solution", "objective", "measures", "seed")},
    )
    grid = np.full(archive.dims, np.nan)
    grid.flat[elites["index"]] = elites["objective"]
    (low, high), (least, most) = ranges
    plt.imshow(
        grid.T,
        origin="lower",
        aspect="auto",
        extent=(low, high, 1e3 * least, 1e3 * most),
        cmap="viridis",
    )
    plt.xlabel("the middle finger's share of the force")
    plt.ylabel("shift of the object [mm]")
    plt.colorbar(label="return")
    plt.savefig("archive.svg")
