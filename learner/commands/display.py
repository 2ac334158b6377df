"""Shows a run: a live screen on a terminal, else one line per generation; JSON or almost nothing on
request.
"""

import json
import logging
from collections.abc import Sequence
from typing import Final

from rich.console import Group
from rich.live import Live
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from farm.commands.logs import Formatter, say
from farm.commands.screen import Console, figure, plain
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report, WorkerStatus
from farm.targets import typed
from learner.commands.options import Style
from learner.run import config as configs
from learner.run.launch import Run

_BLOCKS: Final = "▁▂▃▄▅▆▇█"
_SPARK: Final = 80  # characters of a curve, at most
_SPARK_LEAST: Final = 8
_BESIDE_SPARK: Final = 33  # columns for the text beside it
_WORKERS: Final = 6  # workers shown by name


class Display:
    """Shows a run as a context manager, and its end afterwards.

    This base class shows the end only.
    """

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *_: object) -> None:
        """End."""

    def show(self, report: Report) -> None:
        """Show a finished generation."""

    def conclude(self, lines: Sequence[str]) -> None:
        """Show the end of the run; the lines have the result and the next commands."""
        say(*lines)


def display(run: Run, announcement: Sequence[str], style: Style) -> Display:
    """The display for the user's options and standard output.

    The announcement describes the run.
    """
    if style == "json":
        return JsonDisplay(run)
    if style == "quiet":
        return Display()
    console = Console()
    return (
        LiveDisplay(console, run, announcement)
        if console.is_terminal
        else PlainDisplay(run, announcement)
    )


class PlainDisplay(Display):
    """One line per generation."""

    def __init__(self, run: Run, announcement: Sequence[str]) -> None:
        self._generations = run.learner.config.generations
        say(*announcement)

    def show(self, report: Report) -> None:
        """Write the line."""
        p = report.progress
        succeeds = ""
        share = ""
        if p.success_rate is not None:
            succeeds = f" {'succeeds' if p.mean_policy_success else '-':8}"
            share = f"  {p.success_rate:4.0%} succeed"
        say(
            f"generation {p.generation:>{len(str(self._generations))}}/{self._generations}"
            f"  return {figure(p.return_mean):>8}{_failed(p)}{share}"
            f"  mean policy {_mean_policy(p):>8}{succeeds}{_validation(p)}{_measures(p)}"
            f"  sigma {p.sigma_mean:6.3f}  {report.rate:5.0f} rollouts/s  {p.workers} workers"
        )


def _failed(p: GenerationStats) -> str:
    """Number of rollouts that failed, if any did."""
    return f" ({p.failed} failed)" if p.failed else ""


def _mean_policy(p: GenerationStats) -> str:
    """The mean policy's return."""
    return figure(p.mean_policy_return) if p.mean_policy_return is not None else "fails"


def _validation(p: GenerationStats) -> str:
    """Return of the mean policy from the starts of validation, where that is measured."""
    return "" if p.validation is None else f"  validation {figure(p.validation):>8}"


def _measures(p: GenerationStats) -> str:
    """The mean policy's measures."""
    measures = (
        (name, value) for name, value in p.mean_policy_measures.items() if value is not None
    )
    return "".join(f"  {plain(name)} {value:.3g}" for name, value in measures)


class JsonDisplay(Display):
    """One JSON object per line: the run, each generation as in progress.jsonl, at last the
    summary.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        folder = str(run.learner.folder.path)
        self._say(
            "run",
            {"folder": folder, "live": run.live, "config": configs.to_dict(run.learner.config)},
        )

    def show(self, report: Report) -> None:
        """Write the generation."""
        self._say(
            "generation",
            {**report.progress.to_dict(), "rollouts_per_second": round(report.rate, 1)},
        )

    def conclude(self, lines: Sequence[str]) -> None:  # noqa: ARG002  the summary has everything
        """Write the summary."""
        self._say("summary", self._run.summary)

    def _say(self, event: str, values: dict[str, object]) -> None:
        say(json.dumps({"event": event, **values}))


class LiveDisplay(Display):
    """Returns, sigma, workers, recording and a progress bar, refreshed in place; messages scroll
    above.
    """

    def __init__(self, console: Console, run: Run, announcement: Sequence[str]) -> None:
        self._run, self._console = run, console
        say(*announcement)
        columns = (
            BarColumn(None),
            MofNCompleteColumn(),
            TextColumn("time left"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(TextColumn("generation"), *columns, console=console, expand=True)
        done = run.learner.state.generation
        self._task = self._bar.add_task("", total=run.learner.config.generations, completed=done)
        self._live = Live(self._screen(None), console=console, refresh_per_second=8)
        self._handler = RichHandler(console=console, show_path=False, show_level=False)
        self._handler.setFormatter(Formatter("%(message)s"))
        self._returns: list[float] = []
        self._validation: float | None = None
        self._before: list[logging.Handler] = []

    def __enter__(self) -> "LiveDisplay":
        """Take the terminal; messages are printed above the screen."""
        root = logging.getLogger()
        self._before = [h for h in root.handlers if type(h) is logging.StreamHandler]
        for handler in self._before:
            self._handler.setLevel(handler.level)
            root.removeHandler(handler)
        root.addHandler(self._handler)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        logging.getLogger().removeHandler(self._handler)
        for handler in self._before:
            logging.getLogger().addHandler(handler)

    def show(self, report: Report) -> None:
        """Refresh."""
        if report.progress.mean_policy_return is not None:
            self._returns.append(report.progress.mean_policy_return)
        if report.progress.validation is not None:
            self._validation = report.progress.validation
        self._bar.update(self._task, completed=report.progress.generation)
        self._live.update(self._screen(report))

    def _screen(self, report: Report | None) -> Group:
        rows = (
            [self._bar]
            if report is None
            else [self._learning(report), self._farm(report), self._bar]
        )
        return Group(*rows)

    def _learning(self, report: Report) -> Table:
        p = report.progress
        table = _grid()
        extremes = f"{figure(p.return_min)} to {figure(p.return_max)}, best {figure(p.best)}"
        table.add_row("return", figure(p.return_mean), extremes)
        verdicts = {
            True: Text("succeeds", "green"),
            False: Text("does not succeed", "yellow"),
            None: Text(),
        }
        table.add_row("mean policy", _mean_policy(p), verdicts[p.mean_policy_success])
        if self._returns:
            first, now = self._returns[0], self._returns[-1]
            width = max(_SPARK_LEAST, min(_SPARK, self._console.width - _BESIDE_SPARK))
            curve = Text.assemble((spark(self._returns, width), "cyan"), f" {now:.3f}")
            table.add_row("  so far", f"{first:.3f}", curve)
        if self._validation is not None and (best := self._run.learner.at.validated) is not None:
            which = (
                f"the mean policy's; best {figure(best.score)} after generation {best.generation}"
            )
            table.add_row("validation", figure(self._validation), which)
        if p.success_rate is None:
            table.add_row("failed", str(p.failed), "of the rollouts")
        else:
            failures = f"{p.ended} rollouts ended early, {p.failed} failed"
            table.add_row("success", f"{p.success_rate:.0%}", failures)
        for name, value in p.mean_policy_measures.items():
            both = ["-" if each is None else f"{each:.3g}" for each in (value, p.measures[name])]
            table.add_row(
                plain(name),
                both[0],
                f"the mean policy's; {both[1]} of the exploring ones on average",
            )
        table.add_row(
            "sigma",
            f"{p.sigma_mean:.3f}",
            f"{p.sigma_min:.3f} to {p.sigma_max:.3f}, |mu| {p.mean_norm:.2f}",
        )
        return table

    def _farm(self, report: Report) -> Table:
        p, workers = report.progress, self._run.pool.census()
        table = _grid()
        extra = f"; {p.reissued} jobs reissued" if p.reissued else ""
        # Rounded first, so that the parts add up
        rates = [round(worker.rate) for worker in workers]
        table.add_row("farm", f"{sum(rates)}", f"rollouts/s, {p.workers} workers{extra}")
        for worker, rate in zip(workers[:_WORKERS], rates, strict=False):
            table.add_row("", f"{rate}", plain(name(worker)))
        if len(workers) > _WORKERS:
            table.add_row("", f"{sum(rates[_WORKERS:])}", f"{len(workers) - _WORKERS} more")
        if self._run.recording is not None:
            dropped = self._run.recording.dropped
            left_out = f"; {dropped} rollouts left out: it could not keep up" if dropped else ""
            view = f"farm view {typed(self._run.learner.folder.path)}"
            table.add_row("recording", "", plain(f"{view}{left_out}"))
        if self._run.live is not None:
            table.add_row("live", "", plain(f"farm view {self._run.live}"))
        return table


def name(worker: WorkerStatus) -> str:
    """A worker's name for display: name and process, and its host if that has a different name."""
    short, _, instance = worker.worker.partition("/")
    process = instance.partition("-")[0]
    return f"{short}/{process}" + ("" if worker.host.startswith(short) else f" on {worker.host}")


def spark(values: Sequence[float], width: int) -> str:
    """A curve of at most this number of characters: the last value of each part."""
    count = min(width, len(values))
    points = [values[(i + 1) * len(values) // count - 1] for i in range(count)]
    low = min(values)
    span = (max(values) - low) or 1.0
    return "".join(_BLOCKS[int((v - low) / span * (len(_BLOCKS) - 1))] for v in points)


def _grid() -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=11, style="bold")
    table.add_column(min_width=7, justify="right")
    table.add_column(no_wrap=True, overflow="ellipsis")
    return table
