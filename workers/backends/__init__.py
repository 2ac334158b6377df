"""What a worker simulates with, by name."""

from collections.abc import Sequence
from typing import ClassVar, Final, Protocol

from farm.arrays import FloatArray
from farm.net.jobs import Job
from farm.net.messages import Spec
from farm.net.results import Result
from workers.backends.cpu import CpuBackend


class Backend(Protocol):
    """Runs one run's jobs; made from its specification."""

    capacity: ClassVar[int]
    """Jobs that are worth holding at a time."""

    def __init__(self, spec: Spec) -> None:
        """Build the run's task; UnservedError when it is not known here, ConfigError when it cannot be built."""

    @property
    def parameters(self) -> int:
        """Length P of a parameter vector."""
        ...

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Run jobs around a mean (P,); results in the jobs' order.

        Each has a return for each sign, and a trajectory unless the job's rate is `none`; anything else is a failure.
        """
        ...

    def close(self) -> None:
        """Give back what it holds."""


BACKENDS: Final[dict[str, type[Backend]]] = {
    "cpu": CpuBackend,
}
"""Backends by name."""
