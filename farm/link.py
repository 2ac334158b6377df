"""How programs reach a farm: the flags that all of them share, declared and checked once."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from farm.net import keys
from farm.net.tls import Bundle, Role, find
from farm.net.zenoh_settings import LISTEN, check_endpoint
from farm.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class Link(Settings):
    """The address of a farm, and the certificates for it."""

    role: ClassVar[Role] = "learner"
    """Whose certificate the program shows."""

    connect: tuple[str, ...] = ()
    """Connect to this router of a farm, repeatable."""
    farm: str = keys.FARM
    """Name of the farm: learners and workers with the same name work together."""
    tls: Path | None = None
    """Folder with certificates (farm certificates makes it); needed for tls/HOST:PORT."""

    def __post_init__(self) -> None:
        super().__post_init__()
        keys.checked("farm", self.farm)
        for endpoint in self.connect:
            check_endpoint(endpoint, encrypted=self.tls is not None)

    @property
    def bundle(self) -> Bundle | None:
        """The certificates; a ConfigError if the folder has none for this role."""
        return None if self.tls is None else find(self.tls, self.role)

    @property
    def usual(self) -> str:
        """The usual address of a learner or router on this machine."""
        return LISTEN if self.tls is None else LISTEN.replace("tcp/", "tls/")

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Addresses to connect to."""
        return self.connect or (self.usual,)


@dataclass(frozen=True, kw_only=True)
class Joining(Link):
    """A program that connects to a learner or a router."""

    role: ClassVar[Role] = "viewer"

    connect: tuple[str, ...] = ()
    """Where a learner or a router listens, repeatable; by default tcp/127.0.0.1:7447."""
    name: str = ""
    """Which viewer's certificate to use, if the folder holds several."""
    timeout: float | None = setting(None, least=0.0, most=1e6)
    """Give up if no learner or router answers for this long at the start [s].

    By default keep trying.
    """

    @property
    def bundle(self) -> Bundle | None:
        """The certificates; a ConfigError if the folder has none for this role and name."""
        return None if self.tls is None else find(self.tls, self.role, self.name)


@dataclass(frozen=True, kw_only=True)
class Listening(Link):
    """A program that workers connect to: a learner or a router."""

    connect: tuple[str, ...] = ()
    """Connect to this router, repeatable: a learner then does not listen itself."""
    listen: str | None = None
    """Where it listens; by default tcp/127.0.0.1:7447, with --tls tls/127.0.0.1:7447."""
    trust_network: bool = False
    """Listen to other machines without certificates: everyone there can read everything and pose as
    a worker.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.listen is not None:
            check_endpoint(self.listen, encrypted=self.tls is not None)
