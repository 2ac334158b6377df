"""`farm plot`: the figures of an experiment's folder again, from its recorded data."""

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.folder import ExperimentFolder
from farm import settings as arguments
from farm.errors import ConfigError, RunError


@dataclass(frozen=True, kw_only=True)
class PlotCommand:
    """The figures of an experiment again, from its recorded data: PNG and SVG."""

    folder: tyro.conf.Positional[Path]
    """Folder that farm experiment made."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(PlotCommand, words, "farm plot")
    check_matplotlib()
    folder = ExperimentFolder.open(command.folder)
    folder.gather()
    draw(folder)
    return 0


def check_matplotlib() -> None:
    """Whether matplotlib is there; it is an extra.

    Raises:
      ConfigError: it is not; says what to install.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("figures need matplotlib: pip install 'rolloutfarm[figures]'")


def draw(folder: ExperimentFolder) -> None:
    """Measure what is missing, draw every figure, and say what came out.

    Raises:
      RunError: a figure cannot be written.
    """
    from benchmarks.thesis.figures import draw as drawn
    from benchmarks.thesis.findings import judge, verdict
    from benchmarks.thesis.measure import measure

    for name in folder.experiments:
        experiment = EXPERIMENTS[name]
        if experiment.curves and all(series.empty for series in folder.data(experiment).series.values()):
            sys.stdout.write(f"{name}: none of its runs has begun\n")
            continue
        measure(folder, experiment)
        data = folder.data(experiment)
        try:
            paths = drawn(experiment, data, folder.path)
        except OSError as error:
            raise RunError(f"cannot write the figure of {name}: {error.strerror}") from None
        sys.stdout.write(f"{name}: {' and '.join(map(str, paths))}\n")
        for label, series in data.series.items():
            for failure in series.failures():
                sys.stdout.write(f"  {label}: {failure}\n")
        found = judge(experiment, data)
        for finding in found:
            sys.stdout.write(f"  {'yes' if finding.holds else 'no '}  {finding.part}: {finding.numbers}\n")
        if folder.generations is not None:
            sys.stdout.write(f"  runs are cut to {folder.generations} generations: that says little about the claim\n")
        elif experiment.claim and found:
            sys.stdout.write(f"  {verdict(found)}\n")
    sys.stdout.flush()
