"""Data sets: episodes of a learnt policy on perturbed starts, simulated by workers, written part by
part.

    manifest.json     what the data set is of, and SHA-256 of its files; without them unfinished
    run/              what is needed of the run to make the same bytes again
    unfinished.json   the parts that are written, and whose answers are in them; removed at the end
    data/, meta/      as in `learner/tools/dataset/lerobot.py`

Each part is a round of jobs, whose size follows from the task alone. So every farm writes the same
files.
"""

import hashlib
import json
import secrets
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import fingerprint, plugins, seeds
from farm.errors import ConfigError, RunError, writing
from farm.net.work import Jobs
from farm.returns import known
from farm.settings import read_json
from farm.tasks.rollouts import steps_shape
from learner import parquet
from learner.pool.admission import Admission
from learner.pool.connection import connected
from learner.pool.placement import Placement
from learner.pool.pool import Pool, open_pool
from learner.pool.round import RoundResults, bits
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import Checkpoint
from learner.run.files import replace_text
from learner.run.folder import RunFolder
from learner.run.setup import Problem
from learner.tools.dataset.lerobot import Episode, Format
from learner.tools.replay.loaded import policy_of, restored

PART: Final = 16 << 20
"""Traces of a part [bytes]: a round's results are in memory, and two rounds at most."""
_MOST: Final = 1000  # episodes of a part
_REPEATED: Final = 50  # of so many episodes of other machines this one repeats one
_VERSION: Final = 1
MOST_EPISODES: Final = 10_000_000
"""Largest number of episodes of a data set."""


@dataclass(frozen=True)
class DataSet:
    """A data set in a folder, perhaps unfinished."""

    path: Path
    episodes: int
    seed: int
    files: tuple[Path, ...] = ()
    """Files that the user named, like those of `RunFolder`."""
    last: bool = False
    """Whether the policy is the run's last one, though a validated one is better."""

    @property
    def manifest(self) -> Path:
        """File that says what the data set is of."""
        return self.path / "manifest.json"

    @property
    def run(self) -> RunFolder:
        """Copy of the run in the data set."""
        return RunFolder(self.path / "run", self.files)

    def begin(self, run: RunFolder) -> bool:
        """Prepare the folder for a run's data set, or find it there; return whether it is finished.

        Raises:
          ConfigError: another data set or something else is there.
        """
        head = self._head(run)
        if not self.manifest.exists():
            copies = set[Path]()
            if run.path.resolve() != self.run.path.resolve():  # a command was killed
                copies = {self.run.path, _unfinished_copy(self.run.path)}
            if self.path.exists() and not copies.issuperset(self.path.iterdir()):
                raise ConfigError(
                    f"{self.path} is not empty, and has no manifest.json: choose another --out"
                )
            with writing(self.path):
                if not self.run.path.exists():
                    _copy(run, self.run.path)
                replace_text(self.manifest, json.dumps(self._head(self.run), indent=2) + "\n")
        manifest = read(self.manifest)
        for name in (name for name in head if manifest.get(name) != head[name]):
            raise ConfigError(
                f"{self.path} has another data set: its {name} is {str(manifest.get(name))[:100]},"
                f" not {str(head[name])[:100]}: choose another --out"
            )
        return "files" in manifest

    def _head(self, run: RunFolder) -> dict[str, Any]:
        """What the manifest says from its beginning."""
        config, at = run.read_config(), checkpoints.load(run.checkpoint)
        return {
            **({"last": True} if self.last else {}),
            "version": _VERSION,
            "format": "LeRobot v3.0",
            "run": at.run,
            "task": _wire("tasks", config.task),
            "policy": _wire("policies", config.policy),
            "generation": policy_of(run, at, last=self.last)[0],
            "checkpoint": _digest(run.checkpoint),
            "config": _digest(run.path / "config.json"),
            "code": at.code,
            "numbers": fingerprint.digest(),
            "episodes": self.episodes,
            "seed": self.seed,
            "seeds": "episode i: (4, seed, i, 0)",
            "pyarrow": parquet.release(),
        }

    def check_files(self) -> None:
        """Check that the files of a finished data set are those of its manifest.

        Raises:
          RunError: one has other bytes, or is missing.
        """
        for name, digest in read(self.manifest)["files"].items():
            file = self.path / name
            if not file.is_file() or _digest(file) != digest:
                what = "has other bytes" if file.is_file() else "is missing"
                raise RunError(
                    f"{file} {what}, after {self.manifest} was written: make it again in another"
                    " folder"
                )

    def make(self, place: Placement, stopped: Callable[[], bool]) -> Iterator[int]:
        """Simulate and write what is missing; yield the number of finished episodes.

        Raises:
          RunError: a file cannot be written, or a worker's numbers are wrong.
          Stopped: it was asked to stop; the parts that are finished stay.
        """
        at = checkpoints.load(self.run.checkpoint)
        work = Work(self, restored(self.run, at), at, place.connect != ())
        if work.next < work.parts:
            name = f"dataset-{secrets.token_hex(4)}"
            admission = Admission(fingerprint.digest(), work.expelled)
            with (
                connected(work.problem, place, stopped) as connection,
                open_pool(
                    connection, work.problem, name, admission, generations=work.parts, steps=True
                ) as pool,
            ):
                yield from work.learn(pool)
        work.format.finish(work.parts)
        files = sorted(
            each for each in self.path.rglob("*") if each.is_file() and each.parent != self.path
        )
        done = {
            "numbers_sha256": (
                hashlib.sha256("".join(each["numbers"] for each in work.done).encode()).hexdigest()
            ),
            "files": {str(each.relative_to(self.path)): _digest(each) for each in files},
        }
        with writing(self.manifest):
            replace_text(self.manifest, json.dumps(read(self.manifest) | done, indent=2) + "\n")
            work.file.unlink(missing_ok=True)


class Work:
    """The parts of a data set that are written, and the next one."""

    def __init__(self, of: DataSet, problem: Problem, at: Checkpoint, repeats: bool) -> None:
        self.problem = problem
        self._of = of
        self._repeats = repeats
        config = of.run.read_config()
        _, self._mu, normaliser = policy_of(of.run, at, last=of.last)
        self._normaliser = np.stack([normaliser] * 2)
        self.format = Format(of.path, problem.spec, _wire("tasks", config.task))
        self.file = of.path / "unfinished.json"
        size = int(np.prod(steps_shape(problem.spec))) * 4
        self._each = max(1, min(_MOST, PART // size))
        self.parts = -(-of.episodes // self._each)
        state = _unfinished(self.file)
        self.done: list[dict[str, Any]] = state["done"]
        """Digest of the numbers, control steps, and the hosts that simulated it, for each finished
        part
        """
        self.expelled: dict[str, str] = state["expelled"]
        """Hosts that returned wrong numbers, and the reasons."""

    @property
    def next(self) -> int:
        """The number of the next part."""
        return len(self.done)

    def learn(self, pool: Pool) -> Iterator[int]:
        """Simulate and write the parts that are missing."""
        jobs = self._begin(pool)
        while self.next < self.parts:
            first = self.next * self._each
            for results in pool.progress(checked=self.next + 1 == self.parts):
                yield first + int(results.done.sum())
            if self._undone(pool):
                jobs = self._begin(pool)
                continue
            results = pool.collect()
            hosts = pool.hosts
            done = jobs
            if self.next + 1 < self.parts:  # workers go on while this part is written
                jobs = self._begin(pool, ahead=1)
            self._check(results, done, first, hosts)
            self._write(results, done, first, hosts)

    def _begin(self, pool: Pool, ahead: int = 0) -> Jobs:
        part = self.next + ahead
        rows = range(part * self._each, min(self._of.episodes, (part + 1) * self._each))
        jobs = Jobs.mean("none", [seeds.evaluation_start(self._of.seed, row) for row in rows])
        pool.begin(part, self._mu, jobs, "steps", self._normaliser, terms=True)
        return jobs

    def _undone(self, pool: Pool) -> bool:
        """Whether hosts were expelled: the parts from the first one with their answers on are made
        again.
        """
        new = pool.admission.expelled.keys() - self.expelled.keys()
        if not new:
            return False
        self.expelled.update(pool.admission.expelled)
        first = next(
            (i for i, part in enumerate(self.done) if new & {*part["hosts"]}), len(self.done)
        )
        del self.done[first:]
        self._save()
        return True

    def _check(self, results: RoundResults, jobs: Jobs, first: int, hosts: list[str]) -> None:
        """Repeat some episodes on this machine, if others have simulated them, and compare every
        number.

        Raises:
          RunError: one differs.
        """
        if not self._repeats:
            return
        count = -(-len(jobs) // _REPEATED)
        rows = sorted(
            np.random.default_rng(secrets.randbits(64))
            .choice(len(jobs), count, replace=False)
            .tolist()
        )
        repetition = self._runner.run(
            self._mu, jobs.take(rows), "steps", self._normaliser, terms=True
        )
        for at, row in enumerate(rows):
            alike = bits(repetition, slice(at, at + 1)) == results.answer(row)
            if not alike or repetition.traces[at].tobytes() != results.traces[row].tobytes():
                raise RunError(
                    f"episode {first + row} has other numbers here than a worker sent: of"
                    f" {', '.join(hosts)} one lies, or is broken; without it the same command"
                    " continues"
                )

    @cached_property
    def _runner(self) -> Any:  # noqa: ANN401
        return self.problem.runner()

    def _write(self, results: RoundResults, jobs: Jobs, first: int, hosts: list[str]) -> None:
        returns = np.where(known(results.returns), results.returns, np.nan)
        episodes = [
            Episode(
                seed=seed or (),
                steps=results.traces[row][: results.steps[row]],
                value=float(returns[row]),
                success=bool(results.flags[row, 0]),
                failed=bool(results.flags[row, 2]),
            )
            for row, seed in enumerate(jobs.seeds())
        ]
        before = sum(part["frames"] for part in self.done)
        numbers = self.format.write(self.next, first, before, episodes)
        self.done.append(
            {
                "numbers": numbers,
                "frames": sum(len(each.steps) for each in episodes),
                "hosts": hosts,
            }
        )
        self._save()

    def _save(self) -> None:
        with writing(self.file):
            replace_text(
                self.file, json.dumps({"done": self.done, "expelled": self.expelled}) + "\n"
            )


def _wire(kind: str, name: str) -> str:
    """A class's name without its folder, which differs between machines."""
    return plugins.find(kind, name).wire


def read(path: Path) -> dict[str, Any]:
    """The contents of a manifest.json; a ConfigError if it is none, or an entry is impossible."""
    table: dict[str, Any] = read_json(path, _VERSION)
    for name, most in (("episodes", MOST_EPISODES), ("seed", seeds.SEEDS - 1)):
        value, least = table.get(name), int(name == "episodes")
        if type(value) is not int or not least <= value <= most:
            raise ConfigError(
                f"{path}: {name} is {str(value)[:40]!r}; expected a whole number from {least} to"
                f" {most}"
            )
    texts = ("numbers_sha256", "pyarrow") if "files" in table else ("pyarrow",)
    if damaged := [name for name in texts if type(table.get(name)) is not str]:
        raise ConfigError(
            f"{path}: {damaged[0]} is {str(table.get(damaged[0]))[:40]!r}; expected a text"
        )
    if not isinstance(table.get("files", {}), dict):
        raise ConfigError(
            f"{path}: files is {str(table['files'])[:40]!r}; expected a table of digests by path"
        )
    return table


def _unfinished(path: Path) -> dict[str, Any]:
    """The contents of an unfinished.json; a ConfigError if it is none."""
    if not path.exists():
        return {"done": [], "expelled": {}}
    table = read_json(path)
    kinds = {"numbers": str, "frames": int, "hosts": list}
    sound = (
        isinstance(table, dict)
        and type(table.get("done")) is list
        and type(table.get("expelled")) is dict
    )
    if not sound or not all(
        isinstance(part, dict) and all(type(part.get(name)) is kind for name, kind in kinds.items())
        for part in table["done"]
    ):
        raise ConfigError(f"{path} is damaged: choose another --out, or remove the folder")
    return dict(table)


def difference(old: Path, new: Path) -> str:
    """What differs between two finished data sets, by their manifests; nothing if all bytes are the
    same.

    Raises:
      ConfigError: one cannot be read, or is unfinished.
    """
    was, now = read(old), read(new)
    for path, table in ((old, was), (new, now)):
        if not isinstance(table.get("files"), dict):
            raise ConfigError(f"{path} is of an unfinished data set")
    names = [
        name
        for name in now["files"] | was["files"]
        if now["files"].get(name) != was["files"].get(name)
    ]
    if not names:
        return ""
    if now["numbers_sha256"] == was["numbers_sha256"]:
        releases = f"pyarrow is {now['pyarrow']}, and was {was['pyarrow']}"
        return f"the numbers are the same, but the bytes of {len(names)} files are not: {releases}"
    return f"{names[0]} and {len(names) - 1} more files have other numbers"


def _copy(run: RunFolder, to: Path) -> None:
    """Copy what a data set needs of a run; the copy appears with all of it."""
    new = _unfinished_copy(to)
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    for name in (
        "config.json",
        "checkpoint",
        *(["parameters"] if run.read_config().average > 1 else []),
    ):
        shutil.copyfile(run.path / name, new / name)
    if (run.path / "assets").is_dir():
        shutil.copytree(run.path / "assets", new / "assets")
    new.rename(to)


def _unfinished_copy(to: Path) -> Path:
    """Where a copy of a run is before it is complete."""
    return to.with_name(f"{to.name}.new")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
