"""An experiment's folder: its settings, its runs, and the data kept from them.

    experiment.json    names of the experiments, number of trials and of generations
    runs/SETUP-sN/     one run's folder, shared by all experiments that show the set-up
    data/SETUP.npz     the series recorded by the set-up's trials
    data/NAME.npz      measurements on the learnt policies
    NAME.svg, .png     the figure

runs/ may be deleted: figures and findings need only data/.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.thesis import series, setups
from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.experiment import Data, Experiment, trial
from farm.errors import ConfigError
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

_VERSION: Final = 1


@dataclass(frozen=True, kw_only=True)
class ExperimentFolder:
    """The files of one or more experiments."""

    path: Path
    experiments: tuple[str, ...]
    """Their names."""
    trials: int | None
    """Number of trials of every set-up; None: that of its experiment."""
    generations: int | None
    """Number of generations of every run; None: that of its set-up."""

    @classmethod
    def open(cls, path: Path) -> "ExperimentFolder":
        """An existing one.

        Raises:
          ConfigError: there is none, or this release does not know its experiment.
        """
        try:
            body = json.loads((path / "experiment.json").read_text("utf-8"))
        except FileNotFoundError:
            raise ConfigError(
                f"{path} is not an experiment's folder: it has no experiment.json"
            ) from None
        except (OSError, ValueError) as error:
            raise ConfigError(f"cannot read {path / 'experiment.json'}: {error}") from None
        names = (
            body.get("experiments")
            if isinstance(body, dict) and body.get("version") == _VERSION
            else None
        )
        if not isinstance(names, list) or not names:
            raise ConfigError(f"{path / 'experiment.json'} is not of version {_VERSION}")
        trials, generations = body.get("trials"), body.get("generations")
        return cls(
            path=path,
            experiments=tuple(find(str(name)).name for name in names),
            trials=None if trials is None else _count("trials", trials),
            generations=None if generations is None else _count("generations", generations),
        )

    @classmethod
    def prepare(
        cls, path: Path, names: Sequence[str], trials: int | None, generations: int | None
    ) -> "ExperimentFolder":
        """A new folder, or an existing one to continue, perhaps with more trials.

        Raises:
          ConfigError: the folder is another experiment's, or something else's.
        """
        folder = cls(path=path, experiments=tuple(names), trials=trials, generations=generations)
        if (path / "experiment.json").exists():
            former = cls.open(path)
            if former.experiments != folder.experiments:
                raise ConfigError(
                    f"{path} holds {', '.join(former.experiments)}: give a different --out"
                )
            if former.generations != generations:
                count = "all" if former.generations is None else former.generations
                raise ConfigError(
                    f"{path} was started with {count} generations: use the same, or a different"
                    " --out"
                )
            before, after = (
                max(map(each.count, each.setups), default=0) for each in (former, folder)
            )
            if before > after:
                raise ConfigError(
                    f"{path} has {before} trials: give as many or more, or a different --out"
                )
        try:
            if not (path / "experiment.json").exists() and path.exists() and any(path.iterdir()):
                raise ConfigError(
                    f"{path} holds something else and no experiment.json: give a different --out"
                )
            folder.check_runs(go_on=True)
            (path / "runs").mkdir(parents=True, exist_ok=True)
            (path / "data").mkdir(exist_ok=True)
            contents = {
                "version": _VERSION,
                "experiments": list(names),
                "trials": trials,
                "generations": generations,
            }
            aside = path / "experiment.json.new"
            aside.write_text(json.dumps(contents, indent=2) + "\n", "utf-8")
            aside.replace(path / "experiment.json")
        except OSError as error:
            raise ConfigError(f"cannot write to {path}: {error.strerror}") from None
        return folder

    @property
    def setups(self) -> tuple[str, ...]:
        """The set-ups that its experiments show, each once."""
        return tuple(
            dict.fromkeys(name for e in self.experiments for name in EXPERIMENTS[e].curves.values())
        )

    def shown(self, experiment: Experiment) -> int:
        """Number of trials of each set-up that an experiment shows."""
        return self.trials or experiment.trials

    def count(self, setup: str) -> int:
        """Number of trials of a set-up: as many as any of the experiments shows."""
        return max(
            self.shown(EXPERIMENTS[name])
            for name in self.experiments
            if setup in EXPERIMENTS[name].curves.values()
        )

    def config(self, setup: str, number: int) -> RunConfig:
        """Configuration of a trial."""
        return trial(setups.config(setup), number, self.generations)

    def run(self, setup: str, number: int) -> RunFolder:
        """The folder of a trial, which may not exist."""
        return RunFolder(self.path / "runs" / f"{setup}-s{number}")

    @property
    def runs(self) -> dict[Path, RunConfig]:
        """Configurations by run folder, trial by trial, so that each set-up has an early result."""
        counts = {setup: self.count(setup) for setup in self.setups}
        most = max(counts.values(), default=0)
        pairs = [
            (setup, number)
            for number in range(most)
            for setup in self.setups
            if number < counts[setup]
        ]
        return {self.run(*pair).path: self.config(*pair) for pair in pairs}

    def check_runs(self, *, go_on: bool = False) -> None:
        """Check that the runs in the folder have the set-ups' configurations, and that no recorded
        run is missing.

        To continue, every recorded run must exist; to draw figures, all runs of a set-up may be
        missing.

        Raises:
          ConfigError: a run has a different configuration, or is missing.
        """
        for setup in self.setups:
            folders = [self.run(setup, number) for number in range(self.count(setup))]
            presence = [folder.path.exists() for folder in folders]
            for number, folder in enumerate(folders):
                if presence[number] and folder.read_config() != self.config(setup, number):
                    raise ConfigError(
                        f"{folder.path} no longer has the settings of set-up {setup}: give a"
                        " different --out"
                    )
            file = self.path / "data" / f"{setup}.npz"
            states = series.load(file).states if file.exists() and (go_on or any(presence)) else ()
            for folder, exists, state in zip(folders, presence, states, strict=False):
                if state != "missing" and not exists:
                    raise ConfigError(
                        f"{file} has data of {folder.path}, which is gone: put it back, or give a"
                        " different --out"
                    )

    def gather(self) -> None:
        """Bring data/ up to date with the existing runs.

        Raises:
          ConfigError: as check_runs.
        """
        self.check_runs()
        for setup in self.setups:
            folders = [self.run(setup, number) for number in range(self.count(setup))]
            file = self.path / "data" / f"{setup}.npz"
            if any(folder.path.exists() for folder in folders) or not file.exists():
                series.save(file, series.read(folders, self.config(setup, 0)))

    def data(self, experiment: Experiment) -> Data:
        """The data of an experiment.

        Raises:
          ConfigError: nothing has been gathered.
        """
        curves = {
            label: series.load(self.path / "data" / f"{name}.npz")
            for label, name in experiment.curves.items()
        }
        measured = self.measured(experiment)
        return Data(
            series=curves,
            measured=series.read_arrays(measured) if measured.exists() else {},
            configs={label: self.config(name, 0) for label, name in experiment.curves.items()},
        )

    def measured(self, experiment: Experiment) -> Path:
        """The file with the measurements on an experiment's policies."""
        return self.path / "data" / f"{experiment.name}.npz"


def find(name: str) -> Experiment:
    """The experiment with a name.

    Raises:
      ConfigError: there is none; the message lists the names.
    """
    if name not in EXPERIMENTS:
        raise ConfigError(
            f"unknown experiment {name!r}; known are {', '.join(EXPERIMENTS)}, and thesis for all"
            " of them"
        )
    return EXPERIMENTS[name]


def _count(name: str, value: object) -> int:
    if type(value) is not int or not 1 <= value <= 10_000_000:
        raise ConfigError(f"experiment.json: {name} is {value!r}; expected 1 or more")
    return value
