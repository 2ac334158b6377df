"""`farm learner`: the learner alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from farm.net.session import LISTEN
from learner.commands.learning import learn
from learner.commands.options import LearnerOptions, parse
from learner.config import RunConfig
from learner.run import Placement


@dataclass(frozen=True, kw_only=True)
class LearnerCommand:
    """The learner alone; workers join it from this machine or others with `farm worker`."""

    learner: LearnerOptions = field(default_factory=LearnerOptions)
    """Where the run comes from and where it goes."""
    run: RunConfig = field(default_factory=RunConfig)
    """The run."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command, resumed, begin = parse(LearnerCommand, words, "farm learner")
    place = Placement() if command.learner.tls is None else Placement(listen=LISTEN.replace("tcp/", "tls/"))
    return learn(command.learner, command.run, place, resumed, begin)
