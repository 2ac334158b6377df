"""Makes docs/results.md and docs/results/ from a folder of `python -m benchmarks.thesis thesis`.

    python -m docs.results runs/thesis [--machine SENTENCE]        (docs/results itself: the page and figures again)

Data is put beside what is there, and figures are drawn; every number in the tables comes from the data. What is written
by hand stands in docs/results/notes.md: under a heading with the experiment's name, what its result means.
"""

import argparse
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.thesis.catalogue import EXPERIMENTS, TRIALS, minutes
from benchmarks.thesis.experiment import Data, Experiment, judge, spread, verdict
from benchmarks.thesis.figures import draw
from benchmarks.thesis.folder import ExperimentFolder
from benchmarks.thesis.measure import measure

HERE = Path(__file__).parent

HEAD = """# Results

What Plage 2016 found, and the questions it left open, with this project: question by question, claim by claim. This
page is made by `docs/results.py` from the data in `docs/results/`. From a checkout, `python -m benchmarks.thesis plot
docs/results` draws the figures again from it, and `python -m benchmarks.thesis NAME` does an experiment anew (`thesis`
instead of a name all of them; `--list` says what each costs).

A set-up is run with seeds 0 to {last}. Its settings are the preset `thesis` with what the figure's caption or text
says, or what the preset `default` was then: mu 1.75, sigma 0.8, N 15, alpha_mu 0.1 (`docs/method.md`). **Learnt**
means: the final mean policy does the gait on the nominal start and on at least 80 % of 100 perturbed ones. Numbers are
the mean over the trials, and in brackets the least and the greatest. To compare returns (weights *projected*): holding
still gives -5.4, the three-finger grip's commands at once -0.07.

Nothing was tuned until it agreed. A verdict is arithmetic: each part of a claim is a comparison in
`benchmarks/thesis/claims.py`; *reproduced* says that all hold, *in part* some, *not reproduced* none. Why a
result is as it is, is said below it, and what stands behind that in the experiments whose names begin with `why-`.

{machine}

"""


def main() -> None:
    """Copy, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--machine", default="", help="what the experiments ran on, and their commit: a sentence")
    chosen = parser.parse_args()
    folder, out = ExperimentFolder.open(chosen.folder), HERE / "results"
    folder.gather()
    if folder.path.resolve() != out.resolve():
        _take(folder, out)
    machine = out / "machine.txt"
    if chosen.machine:
        machine.write_text(chosen.machine + "\n", "utf-8")
    notes = dict(sections((out / "notes.md").read_text("utf-8"))) if (out / "notes.md").exists() else {}
    whole, parts = ExperimentFolder.open(out), []
    for name in whole.experiments:
        experiment, data = EXPERIMENTS[name], whole.data(EXPERIMENTS[name])
        draw(experiment, data, out)[0].unlink()  # the SVG is enough here
        parts.append(section(experiment, data, notes.get(name, "")))
    head = HEAD.format(last=whole.trials - 1, machine=machine.read_text("utf-8").strip())
    overview = "\n".join(summary(EXPERIMENTS[name], whole.data(EXPERIMENTS[name])) for name in whole.experiments)
    table = f"| experiment | what | verdict |\n|---|---|---|\n{overview}\n\n"
    (HERE / "results.md").write_text(head + table + "\n".join(parts), "utf-8")


def _take(folder: ExperimentFolder, out: Path) -> None:
    """Measure what is missing, and put a folder's data and experiments beside those that are here."""
    (out / "data").mkdir(parents=True, exist_ok=True)
    known = ExperimentFolder.open(out).experiments if (out / "experiment.json").exists() else ()
    for name in folder.experiments:
        experiment = EXPERIMENTS[name]
        measure(folder, experiment)
        for file in {*(f"{setup}.npz" for setup in experiment.curves.values()), f"{name}.npz"}:
            if (folder.path / "data" / file).exists():
                shutil.copy(folder.path / "data" / file, out / "data")
    told = json.loads((folder.path / "experiment.json").read_text("utf-8"))
    told["experiments"] = [name for name in EXPERIMENTS if name in (*known, *folder.experiments)]
    (out / "experiment.json").write_text(json.dumps(told, indent=2) + "\n", "utf-8")


def sections(text: str) -> Iterator[tuple[str, str]]:
    """Heading and body of each part of the notes."""
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        name, _, body = part.partition("\n")
        yield name.strip(), body.strip()


def summary(experiment: Experiment, data: Data) -> str:
    """A row of the overview."""
    found = judge(experiment, data)
    if experiment.claim:
        said = f"**{verdict(found)}**: {sum(f.holds for f in found)} of {len(found)} parts"
    else:
        said = "; ".join(f"{f.part}: {'yes' if f.holds else 'no'}" for f in found) or "open"
    return f"| [{experiment.name}](#{anchor(experiment)}) | {experiment.title} | {said} |"


def anchor(experiment: Experiment) -> str:
    """The heading's address."""
    return re.sub(r"[^a-z0-9 -]", "", heading(experiment).lower()).replace(" ", "-")


def heading(experiment: Experiment) -> str:
    """Name and title."""
    return f"{experiment.name} {experiment.title}"


def section(experiment: Experiment, data: Data, note: str) -> str:
    """An experiment: question, claim, verdict, numbers, figure."""
    found = judge(experiment, data)
    lines = [f"## {heading(experiment)}", "", experiment.question, ""]
    if experiment.claim:
        lines += [f"**Claim.** {experiment.claim}", "", f"**Verdict: {verdict(found)}.**", ""]
    if found:
        lines += ["| | | numbers |", "|---|---|---|"]
        lines += [f"| {f.part} | {'yes' if f.holds else 'no'} | {f.numbers} |" for f in found]
        lines.append("")
    lines += [f"![{experiment.title}](results/{experiment.name}.svg)", ""]
    if note:
        lines += [note, ""]
    if data.series:
        lines += [
            "| set-up | learnt | final return | robust success [%] | rollouts | minutes* |",
            "|---|---|---|---|---|---|",
        ]
        lines += [row(label, data) for label in data.series]
        lines.append("")
    if data.series:
        lines += ["\\* wall time of its runs, four at a time on the same workers.", ""]
    cost = f", about {minutes(tuple(experiment.curves.values())) * TRIALS:.0f} min on two cores" if data.series else ""
    again = f"Again: `python -m benchmarks.thesis {experiment.name}`{cost}"
    lines += [f"{again}; the figure alone: `python -m benchmarks.thesis plot docs/results`.", ""]
    return "\n".join(lines)


def row(label: str, data: Data) -> str:
    """A set-up's line."""
    series = data.series[label]
    ran = int((~np.isnan(series.columns["return_mean"])).sum())
    failed = f" ({', '.join(series.failures())})" if series.failures() else ""
    return (
        f"| {label}{failed} | {int(series.learnt.sum())} of {series.trials} "
        f"| {spread(series.final)} "
        f"| {spread(100 * series.robust, 0)} | {ran * series.rollouts} | {np.nansum(series.seconds) / 60:.0f} |"
    )


if __name__ == "__main__":
    main()
