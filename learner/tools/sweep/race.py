"""A race of settings on one task: successive halving (Jamieson & Talwalkar 2016, algorithm 1; Li et
al. 2018).

All entries learn from the same starts. After each rung they are ordered by the return of their mean
policies from the same perturbed starts, and by its gain since the rung before: many learning curves
are straight over the logarithm of the rollouts, so an entry that still gains may reach more in the
end. The better half goes on, and the last one learns with half of all rollouts. The best of each
kind of policy goes on first: kinds differ most, and in how soon they learn. The winner's policy is
the average of its means over the last tenth of its generations (suffix averaging: Rakhlin, Shamir &
Sridharan 2012), which removes much of the noise of steps that do not shrink.

    race.json               the entries, and their scores at the end of each rung that is over
    ENTRY-sSEED/            the folder of each entry's run; an entry that goes on is resumed
    result.md, figure.svg   the result

A race depends on nothing but its settings: its winner is the same to the last bit for any number of
workers, and after any interruption.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from farm import seeds, settings
from farm.errors import ConfigError, RunError, writing
from farm.net import keys
from farm.processes import cores
from farm.tasks.rollouts import Seed
from learner.run import config as configs
from learner.run import setup
from learner.run.config import RunConfig
from learner.run.files import replace_text
from learner.run.folder import RunFolder
from learner.run.learner import explored
from learner.run.worth import without_learning
from learner.tools.sweep.runs import RunWatcher, Site

MOST: Final = 256
"""Largest number of entries."""

MOST_ROLLOUTS: Final = 100_000_000
"""Largest number of rollouts of a race."""

_VERSION: Final = 1
_LEAST: Final = 2  # generations of an entry in the first rung
_SUFFIX: Final = 10  # one in so many of the winner's generations is averaged, the last ones
_BATCH: Final = 16  # rollouts that are measured
_EFFICIENCY: Final = 0.7  # of a worker on a machine that also runs the learners


@dataclass(frozen=True)
class Entry:
    """One set of settings."""

    name: str
    config: RunConfig
    per_generation: int
    """Exploring rollouts per generation."""

    @property
    def kind(self) -> tuple[str, bool]:
        """Kind of policy: the name, and whether its observations are normalised."""
        return self.config.policy, self.config.policy_config.normalise

    def generations(self, rollouts: int) -> int:
        """Generations with which it has learnt from this number of rollouts."""
        return -(-rollouts // self.per_generation)


@dataclass(frozen=True)
class Rung:
    """A part of the race."""

    entries: int
    """Number of entries that take part."""
    rollouts: int
    """Rollouts of each of them since the beginning, at the end of this rung."""


class RaceWatcher(RunWatcher, Protocol):
    """Receiver of a race's progress."""

    def rung(self, number: int) -> None:
        """Rung `number`, from 0, begins."""


@dataclass
class Race:
    """A race and its folder."""

    path: Path
    entries: tuple[Entry, ...]
    rollouts: int
    """Exploring rollouts of all entries together."""
    scores: list[dict[str, float | None]] = field(default_factory=list)
    """Scores from perturbed starts by entry, for each rung that is over: the mean return, in which
    a failed rollout counts as the worst one less a standard deviation.

    None if a run diverged, or failed from every start.
    """
    without_learning: dict[str, Any] | None = None
    """Figures of doing nothing and of the best constant action, as in summary.json; None before the
    race is over.
    """

    @property
    def rungs(self) -> list[Rung]:
        """Rungs of the race; the last one has one entry."""
        return schedule(len(self.entries), self.rollouts)

    def running(self, number: int) -> list[Entry]:
        """The entries of a rung whose predecessors are over, best first."""
        entries = list(self.entries)
        for done, rung in enumerate(self.rungs[1 : number + 1]):
            entries = kept(entries, self._prospects(done), rung.entries)
        return entries

    def _prospects(self, number: int) -> dict[str, float]:
        """Where the entries of a rung that is over seem to go: its scores, and their gains once
        more.
        """
        scores = self.scores[number]
        before = self.scores[number - 1] if number else self.scores[number]
        prospects = {}
        for name, score in scores.items():
            last = before[name]
            finite = (
                score is not None
                and last is not None
                and math.isfinite(score)
                and math.isfinite(last)
            )
            prospects[name] = score + (score - last) if finite else -math.inf
        return prospects

    @property
    def standing(self) -> list[Entry]:
        """Entries, best first: those still running, then those dropped last, ..., then those
        dropped first.
        """
        order = self.running(len(self.scores))
        for number in reversed(range(len(self.scores))):
            order += [
                entry
                for entry in ordered(self.running(number), self._prospects(number))
                if entry not in order
            ]
        return order

    @property
    def winner(self) -> Entry:
        """The best entry of the rungs that are over."""
        return self.running(len(self.rungs) - 1)[0]

    def folder(self, entry: Entry) -> Path:
        """The folder of an entry's run."""
        return self.path / f"{entry.name}-s{entry.config.seed}"

    def runs(self, number: int) -> dict[Path, RunConfig]:
        """The runs of a rung, by folder."""
        last, runs = number == len(self.rungs) - 1, {}
        for entry in self.running(number):
            generations = entry.generations(self.rungs[number].rollouts)
            average = max(entry.config.average, generations // _SUFFIX if last else 1)
            runs[self.folder(entry)] = replace(
                entry.config, generations=generations, average=average
            )
        return runs

    def run(
        self, site: Site, watcher: RaceWatcher, stopped: Callable[[], bool], *, record: bool
    ) -> bool:
        """Do what is left of the race; the winner's last rung may be recorded.

        Return whether the race is over.

        Raises:
          RunError: an entry failed, or the folder cannot be written.
        """
        for number in range(len(self.scores), len(self.rungs)):
            watcher.rung(number)
            runs = self.runs(number)
            if not site.run(
                runs, watcher, stopped, record=record and number == len(self.rungs) - 1
            ):
                if stopped():
                    return False
                raise RunError(f"rung {number + 1} is not complete: an entry failed, see above")
            self.scores.append(
                {entry.name: _score(self.folder(entry)) for entry in self.running(number)}
            )
            self._write()
        if self.without_learning is None:
            self.without_learning = without_learning(
                setup.problem(self.winner.config), stopped, cores()
            )
            self._write()
        return True

    @property
    def worth(self) -> dict[str, float | None]:
        """Scores of doing nothing and of the best constant action, by what the table calls them."""
        of = self.without_learning or {}
        names = {"nothing": "doing nothing", "constant": "best constant action"}
        return {words: of[name]["score"] for name, words in names.items() if name in of}

    @property
    def learnt(self) -> bool:
        """Whether the winner of a race that is over is better than each policy that learnt
        nothing.
        """
        score = self.scores[-1][self.winner.name]
        others = [value for value in self.worth.values() if value is not None]
        return score is not None and all(score > value for value in others)

    def prepare(self) -> None:
        """Make the folder, or continue with it.

        Raises:
          ConfigError: it belongs to a different race, or is not a race's folder.
        """
        file = self.path / "race.json"
        with writing(f"to {self.path}", ConfigError):
            if file.exists():
                self.scores = self._continued(file)
            elif self.path.exists() and any(self.path.iterdir()):
                raise ConfigError(
                    f"{self.path} holds something else and no race.json: give a different --out"
                )
            self.path.mkdir(parents=True, exist_ok=True)
            self._write()

    def _write(self) -> None:
        with writing(f"to {self.path}"):
            values = {**self._settings(), "scores": self.scores}
            if self.without_learning is not None:
                values["without_learning"] = self.without_learning
            replace_text(self.path / "race.json", json.dumps(values, indent=2))

    def _settings(self) -> dict[str, Any]:
        entries = {entry.name: configs.to_dict(entry.config) for entry in self.entries}
        return {
            "version": _VERSION,
            "rollouts": self.rollouts,
            "entries": json.loads(json.dumps(entries)),
        }

    def _continued(self, file: Path) -> list[dict[str, float | None]]:
        """The scores in an existing race's file, if it is this race."""
        saved, current = read(file), self._settings()
        if saved["rollouts"] != self.rollouts:
            raise ConfigError(
                f"{self.path} was started with --rollouts {saved['rollouts']}; here it is"
                f" {self.rollouts}: use that, or a different --out"
            )
        if list(saved["entries"]) != list(current["entries"]):
            raise ConfigError(
                f"{self.path} has the entries {', '.join(saved['entries'])}: use a different --out"
            )
        for name, values in saved["entries"].items():
            if values != current["entries"][name]:
                raise ConfigError(
                    f"{self.path} was started with different settings of {name}: use a different"
                    " --out"
                )
        self.without_learning = saved.get("without_learning")
        return list(saved["scores"])


def read(file: Path) -> dict[str, Any]:
    """The contents of race.json; a ConfigError if it cannot be read, or is none."""
    race: dict[str, Any] = settings.read_json(
        file, _VERSION, {"rollouts": int, "entries": dict, "scores": list}
    )
    return race


def schedule(entries: int, rollouts: int) -> list[Rung]:
    """The rungs for this number of entries and of rollouts in total.

    As in successive halving, the rungs before the last have equal shares of the rollouts: together
    half of all.
    """
    counts = [entries]
    while counts[-1] > 1:
        counts.append(-(-counts[-1] // 2))
    each = rollouts / 2 / max(len(counts) - 1, 1)
    totals, total = [], 0.0
    for count in counts[:-1]:
        total += each / count
        totals.append(int(total))
    last = int(total + rollouts / 2) if len(counts) > 1 else rollouts
    return [Rung(count, most) for count, most in zip(counts, [*totals, last], strict=True)]


def kept(entries: Sequence[Entry], prospects: Mapping[str, float], count: int) -> list[Entry]:
    """The `count` entries that go on, best first.

    They are the best of each kind of policy, if it has not diverged, and then the best of the
    others.
    """
    best = ordered(entries, prospects)
    kinds: dict[tuple[str, bool], Entry] = {}
    for entry in best:
        if prospects[entry.name] > -math.inf:
            kinds.setdefault(entry.kind, entry)
    choice = [*kinds.values()][:count]
    choice += [entry for entry in best if entry not in choice][: count - len(choice)]
    return [entry for entry in best if entry in choice]


def ordered(entries: Sequence[Entry], prospects: Mapping[str, float]) -> list[Entry]:
    """The entries, best first; those with equal prospects keep their order."""
    return sorted(entries, key=lambda entry: -prospects[entry.name])


def check(race: Race) -> None:
    """Check that the race can be run.

    Raises:
      ConfigError: no entries, too many, two equal ones, too many rollouts, or too few for the first
          rung.
    """
    if race.rollouts > MOST_ROLLOUTS:
        raise ConfigError(f"rollouts is {race.rollouts}; expected at most {MOST_ROLLOUTS}")
    if not 1 <= len(race.entries) <= MOST:
        raise ConfigError(f"there are {len(race.entries)} entries; expected 1 to {MOST}")
    unique: dict[str, Entry] = {}
    for entry in race.entries:
        other = unique.setdefault(json.dumps(configs.to_dict(entry.config)), entry)
        if other is not entry:
            raise ConfigError(
                f"the entries {other.name} and {entry.name} are the same settings: leave one out"
            )
    first = race.rungs[0].rollouts
    largest = max(race.entries, key=lambda entry: entry.per_generation)
    if first < _LEAST * largest.per_generation:
        least = _LEAST * largest.per_generation
        if len(race.rungs) > 1:  # half of all are shared by the rungs before the last
            least *= 2 * len(race.entries) * (len(race.rungs) - 1)
        raise ConfigError(
            f"{race.rollouts} rollouts are {first} for each of {len(race.entries)} entries in the"
            f" first rung, less than {_LEAST} generations of {largest.name}: give --rollouts"
            f" {least} or more, or fewer entries"
        )


def entries_of(base: RunConfig, portfolio: Mapping[str, Mapping[str, Any]]) -> list[Entry]:
    """The entries of a portfolio for the task of a configuration: settings that replace some of it,
    by name.

    Entries that are the same settings as an earlier one are left out.

    Raises:
      ConfigError: a setting is unknown or invalid, or the task cannot be learnt with it.
    """
    entries: dict[str, Entry] = {}
    for name, values in portfolio.items():
        if not isinstance(values, Mapping):
            raise ConfigError(f"entry {name!r}: {values!r:.60}; expected settings by name")
        with described(name):
            entry = entry_of(name, configs.pilot_unless(configs.changed_by(base, values), values))
        entries.setdefault(json.dumps(configs.to_dict(entry.config)), entry)
    return list(entries.values())


def entry_of(name: str, config: RunConfig) -> Entry:
    """An entry with this name.

    Raises ConfigError if the task cannot be learnt with its settings.
    """
    keys.checked("run", f"{name}-s{config.seed}")
    state = setup.problem(config).begin()
    rows = len(explored(config, state)[0])
    return Entry(name, config, rows * len(config.algorithm_config.signs()) * config.episodes)


@contextmanager
def described(name: str) -> Iterator[None]:
    """Let errors about an entry begin with its name."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"entry {name}: {error}") from None


def affordable(entries: Sequence[Entry], minutes: float, processes: int) -> int:
    """Rollouts that this number of processes like this one does in some minutes, from a measurement
    of each entry.

    Half of the rollouts are the winner's, which is not known yet: the slowest entry counts.
    """
    slowest = max(_seconds(entry.config) for entry in entries)
    return int(60.0 * minutes * processes * _EFFICIENCY / slowest)


def _seconds(config: RunConfig) -> float:
    """Time of one rollout in this process, in batches like those of a worker [s]."""
    problem = setup.problem(config)
    runner, state = problem.runner(), problem.begin()
    theta = np.tile(state.mu, (_BATCH, 1))
    starts: list[Seed] = [seeds.evaluation_start(0, i) for i in range(_BATCH)]
    try:
        runner.rollouts(theta, starts)  # the first batch prepares the simulator
        start = time.perf_counter()
        runner.rollouts(theta, starts)
        return (time.perf_counter() - start) / _BATCH
    finally:
        runner.close()


def _score(path: Path) -> float | None:
    """The score of an entry whose run has ended; None if it diverged, or failed from every
    start.
    """
    summary = RunFolder(path).read_summary() or {}
    return summary.get("robust_score") if summary.get("state") == "finished" else None
