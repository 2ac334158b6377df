"""Jobs on this machine's processor, on one thread."""

from collections.abc import Sequence
from typing import ClassVar

from farm.arrays import FloatArray
from farm.net.jobs import Job
from farm.net.messages import Spec
from farm.net.results import Result
from farm.tasks.finger_gait.physics import CAPACITY
from workers.jobs import specified
from workers.tasks import SIMULATES


class CpuBackend:
    """Simulates one run's jobs."""

    capacity: ClassVar[int] = CAPACITY
    """Jobs that are worth holding at a time."""

    def __init__(self, spec: Spec) -> None:
        """Build the run's task from its specification.

        Raises:
          UnservedError: it names something this release does not know, or this machine does not have.
          ConfigError: it cannot be built.
        """
        config, policy = specified(spec)
        self._size = policy.size
        self._task = SIMULATES[config.kind](config, policy)

    @property
    def parameters(self) -> int:
        """Length P of a parameter vector."""
        return self._size

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Run jobs around a mean (P,); results in the jobs' order."""
        return self._task.run(mu, jobs)

    def close(self) -> None:
        """Give back what it holds."""
        self._task.close()
