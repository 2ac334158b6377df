"""Makes docs/results.md and the pages under docs/results/ from a folder of `python -m
benchmarks.thesis thesis`.

    python -m docs.results runs/thesis [--machine SENTENCE]
    python -m docs.results docs/results     only pages and figures

The folder's data is added to docs/results/data, and the figures are drawn. Every number in the
tables comes from the data. The texts written by hand are in docs/results/notes.md: under an
experiment's name, what its result means; under `page NAME`, the answer at the top of a page. There
`{NAME}` becomes an experiment's link and verdict.
"""

import argparse
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.experiment import Data, Experiment, Finding, judge, spread, verdict
from benchmarks.thesis.figures import draw
from benchmarks.thesis.folder import ExperimentFolder
from benchmarks.thesis.measure import measure
from benchmarks.thesis.setups import minutes

HERE = Path(__file__).parent

PAGES: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "direct-learning": (
        "Can the weights of the features be learnt directly?",
        ("fig-4.1", "text-4.1.1", "text-4.1.2", "text-4.3", "why-race", "cosine", "direct-few"),
    ),
    "convergence": ("Does the search converge?", ("fig-4.2", "fig-4.2-fitted")),
    "features": (
        "How many features does the kernel need?",
        ("fig-4.3", "table-3.2", "why-features"),
    ),
    "state-bases": (
        "What should the controller observe?",
        ("fig-4.4", "why-contacts", "equal-accuracy", "fig-4.4-fitted", "equal-accuracy-fitted"),
    ),
    "pairs": (
        "Few pairs per generation, or many?",
        ("fig-4.5", "fig-4.6", "fig-4.5-fitted", "fig-4.6-fitted"),
    ),
    "start": (
        "Where should the search begin?",
        ("text-8000", "why-start", "start-fitted", "why-fitted"),
    ),
    "scaling": ("Does the scale of the returns matter?", ("text-3.5.2",)),
    "baselines": ("Do pairs and baselines help?", ("baselines",)),
    "objects": ("Does it work with other objects?", ("objects", "objects-between")),
    "chain": ("Can gaits be chained?", ("release", "chain")),
    "friction": ("How much friction does it take?", ("friction",)),
}
"""Pages by name: their question, and the experiments that answer it."""

FUTURE: Final = "future-work"
"""The page about the proposals of the thesis (5.2)."""

HEAD = """# Results

These pages test the claims of Plage 2016, and the questions that the thesis leaves open, with this
project: one page per question. `docs/results.py` makes all of them from the data in
`docs/results/`. From a checkout, `python -m benchmarks.thesis plot docs/results` redraws the
figures from this data, and `python -m benchmarks.thesis NAME` repeats an experiment (`thesis`
instead of a name repeats all; `--list` shows how long each takes).

| question | experiment | verdict |
|---|---|---|
{overview}

The thesis proposes future work (5.2): [{future}](results/{future}.md) has the result of each
proposal.

Results with pages of their own:

| question | answer |
|---|---|
| [Is touch needed?](results/touch.md) | {touch} |
| [How often can a chain of gaits be repeated?](results/chain-of-gaits.md) | 42 times or more if learnt with touch |
| [Can an object be turned on and on?](results/turning.md) | a lens by touch, a hundred times in twelve minutes from each of 200 starts (five of five seeds), and either way round as it is told; a cube that is seen, 19 times and more in two minutes (five of five), and at the speed that it is told; a [plate](results/plate.md) by a script and by 14 of 16 learnt policies, until it is lost |
| [Can one policy hold several objects?](results/several-objects.md) | five; so can one trained on the bar alone |
| [How reliably do the presets learn?](results/seeds.md) | `default` with ten of ten seeds, `thesis` with eight of ten |
| [Does a task of one's own learn?](results/own-tasks.md) | beside other libraries the defaults learn more on each of eight on which nothing was chosen |
| [How do the learners compare with published scores?](results/learners.md) | a table per environment |

## How to read the pages

Each set-up was run with the seeds 0 to 4, in some experiments 0 to 29; these runs are its *trials*.
Most set-ups are the preset `thesis` with the settings that the thesis gives in a caption or in the
text. The others are the former preset `default`: mu 1.75, sigma 0.8, N 15, alpha_mu 0.1
([method.md](method.md) explains the symbols). **Learnt** means that the final mean policy succeeds
on the nominal start and on at least 80 % of 100 perturbed starts. Numbers are means over the
trials, with the smallest and the largest in brackets. For comparison, with the weights *projected*
a hand that holds still returns -5.4, and a hand that commands the three-finger grip from the first
step on returns -0.07.

Nothing was tuned to agree with the thesis. Verdicts are computed: `benchmarks/thesis/claims.py`
tests each part of a claim. *Reproduced* means that all parts hold, *in part* that some hold, and
*not reproduced* that none holds and at least one is false. A comparison of set-ups has the p of a
permutation test (one-sided; of every division of five and five trials, of 100 000 drawn ones with
30), or the 95 % interval of a difference (bootstrap). It is true or false only beyond chance (p up
to 0.05; for "as fast" and "nearly as high", an interval within 0.5 of zero, or beyond it), and
otherwise *undecided*. If none of the compared set-ups learns, the comparison *cannot be tested*.
Percentages after "learnt" are the exact 95 % interval of the probability that a trial learns. Our
own questions have no claim, so their tables show which set-ups learn in more than half of their
trials. A text below each result explains it. The evidence for these explanations is in the
experiments whose names begin with `why-`.

{machine}
"""


def main() -> None:
    """Copy the data, and write the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--machine", default="", help="what the experiments ran on, and their commit: a sentence"
    )
    arguments = parser.parse_args()
    folder, out = ExperimentFolder.open(arguments.folder), HERE / "results"
    folder.gather()
    if folder.path.resolve() != out.resolve():
        _take(folder, out)
    machine = out / "machine.txt"
    if arguments.machine:
        machine.write_text(arguments.machine + "\n", "utf-8")
    notes = (
        dict(sections((out / "notes.md").read_text("utf-8"))) if (out / "notes.md").exists() else {}
    )
    whole = ExperimentFolder.open(out)
    experiments = {name: whole.data(EXPERIMENTS[name]) for name in whole.experiments}
    for name, data in experiments.items():
        draw(EXPERIMENTS[name], data, out)[0].unlink()  # the SVG is enough here
    for page in PAGES:
        (out / f"{page}.md").write_text(question(page, experiments, notes), "utf-8")
    (out / f"{FUTURE}.md").write_text(
        filled(notes.get(f"page {FUTURE}", ""), experiments) + "\n", "utf-8"
    )
    head = HEAD.format(
        overview="\n".join(row for page in PAGES for row in summary(page, experiments)),
        future=FUTURE,
        touch=touch(out / "touch" / "bias-0.05.json"),
        machine=machine.read_text("utf-8").strip(),
    )
    (HERE / "results.md").write_text(head, "utf-8")


def _take(folder: ExperimentFolder, out: Path) -> None:
    """Make missing measurements, and add a folder's data and experiments to docs/results."""
    (out / "data").mkdir(parents=True, exist_ok=True)
    names = ExperimentFolder.open(out).experiments if (out / "experiment.json").exists() else ()
    for name in folder.experiments:
        experiment = EXPERIMENTS[name]
        measure(folder, experiment)
        for file in {*(f"{setup}.npz" for setup in experiment.curves.values()), f"{name}.npz"}:
            if (folder.path / "data" / file).exists():
                shutil.copy(folder.path / "data" / file, out / "data")
    contents = json.loads((folder.path / "experiment.json").read_text("utf-8"))
    contents["experiments"] = [
        name for name in EXPERIMENTS if name in (*names, *folder.experiments)
    ]
    (out / "experiment.json").write_text(json.dumps(contents, indent=2) + "\n", "utf-8")


def sections(text: str) -> Iterator[tuple[str, str]]:
    """Heading and body of each part of the notes."""
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        name, _, body = part.partition("\n")
        yield name.strip(), body.strip()


def question(page: str, data: Mapping[str, Data], notes: Mapping[str, str]) -> str:
    """A page: question, answer, verdicts, and a section for each experiment."""
    title, names = PAGES[page]
    names = tuple(name for name in names if name in data)
    answer = filled(notes.get(f"page {page}", ""), data)
    table = ["| experiment | what | verdict |", "|---|---|---|"]
    for name in names:
        table.append(
            f"| {link(name, page)} | {EXPERIMENTS[name].title} |"
            f" {outcome(EXPERIMENTS[name], data[name])} |"
        )
    parts = [section(EXPERIMENTS[name], data[name], notes.get(name, "")) for name in names]
    top = [f"# {title}", *([answer] if answer else []), "\n".join(table)]
    return (
        "\n\n".join(
            [*top, "All questions, and how to read this page: [results.md](../results.md).", *parts]
        )
        + "\n"
    )


def filled(text: str, data: Mapping[str, Data]) -> str:
    """A note in which links and verdicts replace {NAME}."""
    return re.sub(
        r"\{([a-z0-9.-]+)\}",
        lambda m: f"{link(m[1])}: {outcome(EXPERIMENTS[m[1]], data[m[1]])}",
        text,
    )


def link(name: str, page: str = "", folder: str = "") -> str:
    """A link to an experiment's section, from its own page or from another one."""
    at = next(each for each, (_, names) in PAGES.items() if name in names)
    file = "" if at == page else f"{folder}{at}.md"
    return f"[{name}]({file}#{anchor(EXPERIMENTS[name])})"


def summary(page: str, data: Mapping[str, Data]) -> Iterator[str]:
    """A page's rows of the overview."""
    title, names = PAGES[page]
    first = f"[{title}](results/{page}.md)"
    for name in names:
        if name in data:
            what = EXPERIMENTS[name].title
            yield (
                f"| {first} | {link(name, folder='results/')} {what} |"
                f" {outcome(EXPERIMENTS[name], data[name])} |"
            )
            first = ""


def outcome(experiment: Experiment, data: Data) -> str:
    """What came out, in a few words."""
    findings = judge(experiment, data)
    if experiment.claim:
        return (
            f"**{verdict(findings)}**: {sum(f.holds is True for f in findings)} of {len(findings)}"
            " parts"
        )
    return "; ".join(_grouped(findings)) or "open"


def _grouped(findings: Sequence[Finding]) -> list[str]:
    """Findings in a few words; parts with the same last words are joined."""
    end = os.path.commonprefix([f.part[::-1] for f in findings])[::-1]
    _, space, verb = end.partition(" ")
    if len(findings) < 2 or not space:
        return [f"{f.part}: {f.answer}" for f in findings]
    parts = [(f.part.removesuffix(f" {verb}").removesuffix(":"), f.holds) for f in findings]
    yes, no = ([name for name, holds in parts if holds is value] for value in (True, False))
    if not yes:
        return [f"none {verb}"]
    if not no:
        return [f"each {verb}"]
    return [f"{verb}: {_listed(yes)}", f"not: {_listed(no)}"]


def _listed(parts: Sequence[str]) -> str:
    return " / ".join(parts) if any(", " in part for part in parts) else ", ".join(parts)


def touch(path: Path) -> str:
    """The answer of the fragile bar's data."""
    shares = {
        name: 100.0 * np.array(values)
        for name, values in json.loads(path.read_text("utf-8")).items()
    }
    felt, zeroed = shares["forces"], shares["zeroed"]
    blind = [v for n, v in shares.items() if not re.match("forces|cop|tactile|expert|zeroed", n)]
    best = max(np.median(values) for values in blind)
    return (
        "it helps learning, and is not necessary: learnt with three exact forces,"
        f" {int((felt >= 95.0).sum())} of {len(felt)} seeds succeed on at least 95 % of the starts"
        f" (median {np.median(felt):.3g} %); learnt without touch the best median is {best:.3g} %;"
        f" a hand-written controller without touch has {zeroed[0]:.3g} %. It is needed if joint"
        " readings drift, or servos are stiff"
    )


def anchor(experiment: Experiment) -> str:
    """The heading's address."""
    return re.sub(r"[^a-z0-9 -]", "", heading(experiment).lower()).replace(" ", "-")


def heading(experiment: Experiment) -> str:
    """Name and title."""
    return f"{experiment.name} {experiment.title}"


def section(experiment: Experiment, data: Data, note: str) -> str:
    """An experiment: question, claim, verdict, numbers, figure."""
    findings = judge(experiment, data)
    lines = [f"## {heading(experiment)}", "", experiment.question, ""]
    if experiment.claim:
        lines += [f"**Claim.** {experiment.claim}", "", f"**Verdict: {verdict(findings)}.**", ""]
    if findings:
        lines += ["| statement | true? | numbers |", "|---|---|---|"]
        lines += [f"| {f.part} | {f.answer} | {f.numbers} |" for f in findings]
        lines.append("")
    lines += [f"![{experiment.title}]({experiment.name}.svg)", ""]
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
        lines += ["\\* wall time of the set-up's runs; four runs shared the same workers.", ""]
    needed = minutes(tuple(experiment.curves.values())) * experiment.trials
    cost = f", about {needed:.0f} min on two cores" if data.series else ""
    lines += [
        f"To repeat it: `python -m benchmarks.thesis {experiment.name}`{cost}. To redraw only the"
        " figure: `python -m benchmarks.thesis plot docs/results`."
    ]
    return "\n".join(lines)


def row(label: str, data: Data) -> str:
    """A set-up's line."""
    series = data.series[label]
    ran = int((~np.isnan(series.columns["return_mean"])).sum())
    failed = f" ({', '.join(series.failures())})" if series.failures() else ""
    return (
        f"| {label}{failed} | {int(series.learnt.sum())} of {series.trials} |"
        f" {spread(series.final)} | {spread(100 * series.robust, 0)} | {ran * series.rollouts} |"
        f" {np.nansum(series.seconds) / 60:.0f} |"
    )


if __name__ == "__main__":
    main()
