"""What runs the jobs of each kind of task, by the name that `farm.tasks.TASKS` has for it."""

from collections.abc import Sequence
from typing import Final, Protocol

from farm.arrays import FloatArray
from farm.net.jobs import Job
from farm.net.results import Result
from farm.policies.fourier import Policy
from farm.tasks.finger_gait.task import TaskConfig
from farm.tasks.gymnasium import Environment
from workers.finger_gait import Gait


class Simulates(Protocol):
    """Runs one run's jobs; made from the task and the controller."""

    def __init__(self, config: TaskConfig, policy: Policy) -> None:
        """Build the task; ConfigError when it cannot be built here."""

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Run jobs around a mean (P,); results in the jobs' order, with traces where there are fingers."""
        ...

    def close(self) -> None:
        """Give back what it holds."""


SIMULATES: Final[dict[str, type[Simulates]]] = {
    "finger-gait": Gait,
    "gym": Environment,
}
"""What runs the jobs, by kind of task."""
