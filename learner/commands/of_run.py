"""Which policy of a run a command takes."""

from dataclasses import dataclass

from farm.errors import ConfigError
from learner.commands.allowed import AllowedFiles


@dataclass(frozen=True, kw_only=True)
class OfRun(AllowedFiles):
    """A command that takes a run's policy: the best validated one, where the run validates."""

    last: bool = False
    """Take the policy after the last generation, though a validated one is better."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.last and getattr(self, "generation", None) is not None:
            raise ConfigError(
                "--last and --generation exclude each other: each says which policy is taken"
            )
