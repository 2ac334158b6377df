"""Report of a race: a table, a page, and curves."""

import math
import re
import shlex
from typing import Final

from farm.targets import typed
from learner.run import config as configs
from learner.run.evaluation import EVALUATION_ROLLOUTS
from learner.run.folder import RunFolder
from learner.tools.sweep import outcomes
from learner.tools.sweep.outcomes import Curve
from learner.tools.sweep.race import Entry, Race

_PAGE: Final = """# Race on {task}, seed {seed}

{rollouts} exploring rollouts in all. A number is the mean return of an entry's mean policy from
{starts} perturbed starts, the same for all, after so many rollouts of its own. After each rung the
better half went on, judged by this number and its gain since the rung before; every second place
was reserved for other kinds of policies. Before learning, the first entry's mean policy
returned {untrained}.

{table}

{verdict} Its run is in `{folder}`. Without the race,

    {command}

gives the same parameters, to the last bit. The {starts} starts have chosen the winner, so its own
number is a little too good: `farm evaluate {path} --seed 1` tries other starts.
{figure}"""


def plain(text: str) -> str:
    """A name for files, from a task's name or a set of flags; files without their folder."""
    return re.sub(r"[^A-Za-z0-9_.]+", "-", text.rpartition("/")[2].replace(".py:", "-")).strip("-")[
        :80
    ]


def heads(race: Race) -> list[str]:
    """The heads of the table: the entry, and the rollouts of its own at the end of each rung."""
    return ["entry", *(str(rung.rollouts) for rung in race.rungs)]


def rows(race: Race) -> list[list[str]]:
    """The scores of each entry as text, best first.

    Those dropped last come before those dropped first.

    Policies that learnt nothing are below them, when the race is over.
    """
    entries = [[entry.name, *_scores(race, entry)] for entry in race.standing]
    empty = [""] * (len(race.rungs) - 1)
    others = [[name, *empty, _score(score)] for name, score in race.worth.items()]
    return [*entries, *others]


def _score(score: float | None) -> str:
    return "failed" if score is None else f"{score:.4g}"


def _scores(race: Race, entry: Entry) -> list[str]:
    values = [scores[entry.name] for scores in race.scores if entry.name in scores]
    cells = ["diverged" if score is None else f"{score:.4g}" for score in values]
    dropped = len(values) < len(race.rungs) and entry not in race.running(len(race.scores))
    empty = [""] * (len(race.rungs) - len(cells))
    return [*cells, "dropped", *empty[1:]] if dropped else [*cells, *empty]


def command(race: Race) -> str:
    """The winner as a command."""
    winner = race.winner
    config = race.runs(len(race.rungs) - 1)[race.folder(winner)]
    return shlex.join(["farm", "run", *configs.flags(config)])


def page(race: Race, *, figure: bool) -> str:
    """The result as Markdown."""
    winner, table = race.winner, [heads(race), ["---"] * (len(race.rungs) + 1), *rows(race)]
    first = RunFolder(race.folder(race.entries[0])).progress()
    untrained = first[0].mean_policy_return if first else None
    return _PAGE.format(
        task=winner.config.task,
        seed=winner.config.seed,
        rollouts=race.rollouts,
        starts=EVALUATION_ROLLOUTS,
        untrained="-" if untrained is None else f"{untrained:.4g}",
        table="\n".join(f"| {' | '.join(line)} |" for line in table),
        verdict=verdict(race),
        folder=race.folder(winner).name,
        path=typed(race.folder(winner)),
        command=command(race),
        figure="\n![Return of the mean policies over rollouts](figure.svg)\n" if figure else "",
    )


def verdict(race: Race) -> str:
    """Who has won, and whether that is worth anything."""
    if race.learnt:
        return f"**{race.winner.name}** won."
    best = max(
        race.worth,
        key=lambda name: -math.inf if (of := race.worth[name]) is None else of,
        default="",
    )
    return (
        f"No entry won: {race.winner.name} is the best of them, and no better than"
        f" {best or 'a failure'}."
    )


def curves(race: Race) -> list[Curve]:
    """The mean policy's return of every entry, best first."""
    return [outcomes.curve(entry.name, [race.folder(entry)]) for entry in race.standing]
