"""`farm learner`: the learner without workers."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from farm.settings import Settings
from learner.commands import options
from learner.commands.options import LearnerOptions, parse
from learner.run.config import RunConfig

_USUAL: Final = (*options.USUAL, "listen", "connect", "tls", "farm")
"""Settings that `farm learner --help` shows."""


@dataclass(frozen=True, kw_only=True)
class LearnerCommand(Settings):
    """The learner without workers; they join it with `farm worker` from any machine."""

    learner: LearnerOptions = field(default_factory=LearnerOptions)
    """Where the run starts from, where it is saved, and its network addresses."""
    run: RunConfig = field(default_factory=RunConfig)
    """The run."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command, resumed, base = parse(LearnerCommand, words, "farm learner", _USUAL)
    # A help does without them
    from learner.commands.learning import learn
    from learner.pool.placement import Placement

    place = Placement(listen=command.learner.usual)
    return learn(command.learner, command.run, place, resumed, base)
