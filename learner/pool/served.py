"""What a pool needs to know of what its workers simulate."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from farm.net.messages import Spec
from farm.runner import Runner
from learner.pool.round import Shapes


class Served(Protocol):
    """Problem that a pool's workers simulate; `learner.run.setup.Problem` is one."""

    def specification(self, run: str) -> Spec:
        """The specification for workers."""
        ...

    def shapes(self, *, steps: bool = False) -> Shapes:
        """Shapes of results; with `steps` traces are of whole control steps."""
        ...

    def runner(self) -> Runner:
        """Prepare simulation in this process."""
        ...

    @property
    def files(self) -> Sequence[Path]:
        """Files of the problem's classes, which workers must be allowed to serve."""
        ...

    @property
    def sources(self) -> Mapping[str, bytes]:
        """Contents of `files` as they were imported, by SHA-256."""
        ...

    @property
    def assets(self) -> Mapping[str, bytes]:
        """Binary files of the problem's models, by SHA-256."""
        ...
