"""A worker's settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from farm.errors import ConfigError
from farm.link import Joining
from farm.net import keys
from farm.net.tls import Role
from farm.processes import usual_name
from farm.runner import make_backend


@dataclass(frozen=True, kw_only=True)
class WorkerConfig(Joining):
    """A worker's settings."""

    role: ClassVar[Role] = "worker"

    name: str = ""
    """Name of this worker; by default the host's, with --tls the certificate's."""
    backend: str = "cpu"
    """Simulation backend: a name (farm tasks lists them), or FILE.py:CLASS."""
    allow_file: tuple[Path, ...] = ()
    """Serve runs whose task or policy is a class in this file, repeatable.

    The learner's must be the same file.
    """
    accept_code: bool = False
    """Serve runs whose task or policy is a class in a file that the learner sends; with --tls."""

    def __post_init__(self) -> None:
        """Check every value, and fill in the name."""
        super().__post_init__()
        bundle = self.bundle
        if bundle is not None:
            object.__setattr__(self, "name", bundle.name)
        if not self.name:
            object.__setattr__(self, "name", usual_name())
        keys.checked("worker", self.name)
        make_backend(self.backend)
        if self.accept_code and self.tls is None:
            raise ConfigError(
                "--accept-code needs --tls: without certificates anyone could send code"
            )
        for path in self.allow_file:
            if not path.is_file():
                raise ConfigError(f"--allow-file {path}: there is no such file")
