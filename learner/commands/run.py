"""`farm run`: learner and local workers together."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from farm.errors import ConfigError
from farm.net.session import free_endpoint
from farm.runner import make_backend
from farm.settings import Settings, setting
from learner.commands.options import LearnerOptions, parse
from learner.run.config import RunConfig


@dataclass(frozen=True, kw_only=True)
class RunCommand(Settings):
    """Starts a learner and local workers: learns a task and records the run."""

    learner: LearnerOptions = field(default_factory=LearnerOptions)
    """Where the run starts from, where it is saved, and its network addresses."""
    workers: int = setting(2, least=0, most=1024)
    """Worker processes on this machine."""
    backend: str = "cpu"
    """Simulation backend of these workers: a name (farm tasks lists them), or FILE.py:CLASS."""
    run: RunConfig = field(default_factory=RunConfig)
    """The run."""

    def __post_init__(self) -> None:
        super().__post_init__()
        make_backend(self.backend)


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command, resumed, base = parse(RunCommand, words, "farm run")
    # A help does without them
    from learner.commands.learning import learn
    from learner.pool.placement import Placement

    if command.learner.tls is not None:
        raise ConfigError(
            "farm run is for one machine; with --tls start farm learner and farm worker"
        )
    place = Placement(workers=command.workers, backend=command.backend, listen=free_endpoint())
    return learn(command.learner, command.run, place, resumed, base)
