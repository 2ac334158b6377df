"""`farm learner`: the learner alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from farm.commands.learning import learn
from farm.commands.options import LearnerOptions, parse
from farm.local import LISTEN, Place
from learner.config import RunConfig


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
    place = Place() if command.learner.tls is None else Place(listen=LISTEN.replace("tcp/", "tls/"))
    return learn(command.learner, command.run, place, resumed, begin)
