"""The figures of experiments; only this module of benchmarks/thesis imports matplotlib."""

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator, SymmetricalLogLocator

from benchmarks.thesis.claims import features_for
from benchmarks.thesis.experiment import (
    Chain,
    Curves,
    Data,
    Experiment,
    Friction,
    KernelError,
    Panel,
    Transfer,
)
from benchmarks.thesis.series import Series, known_mean
from farm.arrays import FloatArray
from learner.run.config import RunConfig
from learner.run.config import flat as settings

_STYLE: Final = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "svg.hashsalt": "rolloutfarm",
    "svg.fonttype": "none",
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
}

_COLOURS: Final = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#888888",
)
"""Colours of Okabe and Ito, and a grey, for the colour-blind; dashes and markers differ in black
and white.
"""

_DASHES: Final = (
    "-",
    "--",
    "-.",
    ":",
    (0, (5, 1, 1, 1, 1, 1)),
    (0, (8, 2)),
    (0, (1, 2)),
    (0, (3, 3)),
)
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")

_PANELS: Final[dict[Panel, tuple[str, str]]] = {
    "return": ("return_mean", "mean return per generation"),
    "mean policy": ("mean_policy_return", "return of the mean policy"),
    "success": ("success_rate", "successful rollouts [%]"),
    "sigma": ("sigma_mean", "mean sigma"),
    "mu_2": ("mu_2", "mu of the second parameter"),
    "sigma_2": ("sigma_2", "sigma of the second parameter"),
    "action": ("action", "largest action [joint ranges]"),
}
"""Column and label of a panel."""

_RETURNS: Final = ("return", "mean policy")

_OVERFLOWED: Final = -1e9
"""A mean return below which one of at most 1000 returns overflowed.

Those were recorded as -1e12.
"""

_FALLEN: Final = -1000.0  # a mean return below which other values are invisible on a linear axis


def draw(experiment: Experiment, data: Data, folder: Path) -> tuple[Path, Path]:
    """Draw an experiment's figure as NAME.png and NAME.svg in a folder; their paths."""
    drawing = {
        Curves: _curves,
        Transfer: _transfer,
        Friction: _friction,
        Chain: _chain,
        KernelError: _kernel,
    }
    paths = folder / f"{experiment.name}.png", folder / f"{experiment.name}.svg"
    with mpl.rc_context(_STYLE):
        canvas = drawing[type(experiment.figure)](experiment, data)
        canvas.suptitle(experiment.title, x=0.01, ha="left", fontsize=11, fontweight="bold")
        canvas.savefig(paths[0], dpi=110, metadata={"Software": None})
        canvas.savefig(paths[1], metadata={"Date": None, "Creator": None})
    paths[1].write_text(shortened(paths[1].read_text("utf-8")), "utf-8")
    return paths


def shortened(svg: str) -> str:
    """An SVG's coordinates [pt] without the digits that nobody sees, and no indentation: half of
    the file.

    Its texts stay.
    """
    lines = re.sub(r" *\n *", "\n", svg)
    return re.sub(
        r"<[^>]*>", lambda tag: re.sub(r"[1-9]\d*\.\d{3,}", _in_hundredths, tag[0]), lines
    )


def _in_hundredths(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


def _canvas(panels: int, caption: str) -> tuple[Canvas, list[Axes]]:
    """Panels side by side over a caption."""
    lines = textwrap.wrap(caption, 58 * max(panels, 2))
    height = 3.3 + 0.16 * len(lines)
    canvas = Canvas(figsize=(4.0 * max(panels, 2), height))
    axes = canvas.subplots(1, panels, squeeze=False)[0].tolist()
    bottom = 0.16 * len(lines) + 0.62
    canvas.subplots_adjust(
        left=0.105, right=0.985, top=1 - 0.45 / height, bottom=bottom / height, wspace=0.3
    )
    canvas.text(0.01, 0.06 / height, "\n".join(lines), va="bottom", fontsize=8, color="0.3")
    return canvas, axes


def _caption(experiment: Experiment, data: Data) -> str:
    """Caption: the settings that all curves share, and trials that did not finish."""
    trials = max(s.trials for s in data.series.values())
    text = (
        ", ".join(common(list(data.configs.values())))
        + f"; {trials} {'trials' if trials > 1 else 'trial'}"
    )
    if isinstance(experiment.figure, Curves):
        text += (
            "; line: median of the trials still running, shaded: minimum to maximum"
            if _run_away(experiment.figure, data)
            else "; line: mean of the trials still running, shaded: standard deviation"
        )
        if any(_overflowed(series) for series in data.series.values()):
            text += "; below the axis returns overflow"
    text += "."
    broken = [
        f"{label}: {', '.join(s.failures())}" for label, s in data.series.items() if s.failures()
    ]
    return text[0].upper() + text[1:] + (f" Not finished: {'; '.join(broken)}." if broken else "")


def common(configs: Sequence[RunConfig]) -> list[str]:
    """Settings common to all curves, as words of the caption."""
    phrases = (
        lambda c: c["policy"],
        lambda c: c["state"],
        lambda c: f"D {c['features']}" if "features" in c else None,
        lambda c: f"N {c['pairs']}",
        lambda c: None if c["estimator"] == "symmetric" else "plain PGPE",
        lambda c: f"weights {c['weights']}",
        lambda c: c["object"],
        lambda c: f"sigma rule {c['sigma-rule']}",
        lambda c: f"normaliser {c['normaliser']}",
        lambda c: "perturbed training" if c["perturb"] else "unperturbed",
    )
    flat = [settings(config) for config in configs]
    answers = [{tell(config) for config in flat} for tell in phrases]
    return [
        words for values in answers if len(values) == 1 for words in values if words is not None
    ]


def _curves(experiment: Experiment, data: Data) -> Canvas:
    figure = experiment.figure
    assert isinstance(figure, Curves)
    canvas, axes = _canvas(len(figure.panels), _caption(experiment, data))
    for panel, axis in zip(figure.panels, axes, strict=True):
        column, label = _PANELS[panel]
        low, high = [], []
        for i, (name, series) in enumerate(data.series.items()):
            if series.empty:
                continue
            values = data.measured["action"][i] if panel == "action" else series.columns[column]
            if panel == "success":
                values = 100 * values
            step = series.rollouts if figure.over == "rollouts" else 1
            line = _line(axis, i, name, values, step, run_away=_run_away(figure, data))
            low.append(np.nanmin(line))
            high.append(np.nanmax(line))
        axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axis.set_xlabel("generation" if figure.over == "generations" else "rollouts")
        axis.set_ylabel(label)
        _scale(
            axis,
            panel,
            min(low, default=0.0),
            max(high, default=1.0),
            run_away=_run_away(figure, data),
        )
    if len(data.series) > 1 and axes[-1].lines:
        axes[-1].legend(loc="best", fontsize=8)
    return canvas


def _run_away(figure: Curves, data: Data) -> bool:
    """Whether the returns of a trial fell so far that this trial alone would determine the mean."""
    curves = (series for series in data.series.values() if not series.empty)
    return figure.scale == "symlog" and any(
        np.nanmin(series.columns["return_mean"]) < _FALLEN for series in curves
    )


def _overflowed(series: Series) -> bool:
    """Whether a mean return of a trial has one in it that overflowed."""
    means = (series.columns[column] for column in ("return_mean", "mean_policy_return"))
    return any(bool((values < _OVERFLOWED).any()) for values in means)


def _scale(axis: Axes, panel: Panel, low: float, high: float, *, run_away: bool) -> None:
    if panel in _RETURNS and run_away:
        axis.set_yscale("symlog", linthresh=10)
        few = SymmetricalLogLocator(base=10, linthresh=10)
        few.set_params(numticks=6)
        axis.yaxis.set_major_locator(few)
        axis.set_ylim(max(axis.get_ylim()[0], _OVERFLOWED), None)
    if panel in ("sigma", "sigma_2", "action"):
        axis.set_yscale("log")
    if panel == "success":
        axis.set_ylim(-3, 103)
    elif panel in _RETURNS and not run_away:
        room = 0.08 * (high - low)
        axis.set_ylim(low - 3 * room, high + room)


def _line(
    axis: Axes, i: int, name: str, values: FloatArray, step: int = 1, *, run_away: bool = False
) -> FloatArray:
    """Draw the i-th line of a panel, its spread shaded, and return it: values (trials,
    generations), `step` apart.

    Generations that no trial reached are left out. The line is the mean with its standard
    deviation; if a trial ran away, it is the median with minimum and maximum.
    """
    present = ~np.isnan(values)
    values = values[:, : int(present.any(axis=0).sum())]
    if run_away:
        low = np.nanmin(values, axis=0)
        line = np.nanmedian(values, axis=0)
        high = np.nanmax(values, axis=0)
    else:
        line, spread = _spread(values)
        low, high = line - spread, line + spread
    x, began = step * np.arange(1, len(line) + 1), int(present[:, 0].sum())
    axis.plot(
        x,
        line,
        color=_COLOURS[i],
        linestyle=_DASHES[i],
        marker=_MARKERS[i],
        ms=4,
        lw=1.5,
        markevery=(len(x) // 20 + i, max(len(x) // 6, 1)),
        label=name if began == len(values) else f"{name} ({began})",
    )
    axis.fill_between(x, low, high, color=_COLOURS[i], alpha=0.15, lw=0)
    return line


def _spread(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation over the trials that have data."""
    mean = known_mean(values, axis=0)
    return mean, np.sqrt(known_mean((values - mean) ** 2, axis=0))


def _transfer(experiment: Experiment, data: Data) -> Canvas:
    assert isinstance(experiment.figure, Transfer)
    caption = (
        _caption(experiment, data)
        + " Left: learning. Right: robust success [%] with the column's object of policies learnt"
        " with the row's object: mean over the trials."
    )
    canvas, (left, right) = _canvas(2, caption)
    for i, (name, series) in enumerate(data.series.items()):
        if series.empty:
            continue
        _line(left, i, name, 100 * series.columns["success_rate"])
    left.set(xlabel="generation", ylabel="successful rollouts [%]", ylim=(-3, 103))
    if left.lines:
        left.legend(loc="lower right", fontsize=8)
    rate = 100 * known_mean(data.measured["transfer"], axis=1)
    right.imshow(rate, cmap="Blues", vmin=0, vmax=110, aspect="auto")
    for (row, column), value in np.ndenumerate(rate):
        right.text(
            column,
            row,
            f"{value:.0f}",
            ha="center",
            va="center",
            color="white" if value > 60 else "black",
        )
    right.set_xticks(range(len(experiment.figure.objects)), experiment.figure.objects)
    right.set_yticks(range(len(data.series)), list(data.series))
    right.set(xlabel="tried with", ylabel="learnt with")
    for side in ("left", "bottom"):
        right.spines[side].set_visible(False)
    right.tick_params(length=0)
    return canvas


def _friction(experiment: Experiment, data: Data) -> Canvas:
    caption = (
        _caption(experiment, data)
        + " Robust success of the final mean policies if every friction coefficient is multiplied"
        " by the factor, and mass, position and joint readings are perturbed: mean over the"
        " trials, shaded: standard deviation."
    )
    canvas, (axis,) = _canvas(1, caption)
    factors = data.measured["factors"]
    for i, (name, rate) in enumerate(zip(data.series, 100 * data.measured["success"], strict=True)):
        mean, spread = _spread(rate)
        style = {"color": _COLOURS[i], "linestyle": _DASHES[i], "marker": _MARKERS[i]}
        axis.plot(factors, mean, **style, ms=5, lw=1.5, label=name)
        axis.fill_between(
            factors, mean - spread, mean + spread, color=_COLOURS[i], alpha=0.15, lw=0
        )
    axis.set_xscale("log")
    axis.set_xticks(factors, [f"{f:g}" for f in factors], minor=False)
    axis.minorticks_off()
    axis.set(xlabel="factor of friction", ylabel="robust success [%]", ylim=(-3, 103))
    axis.legend(fontsize=8)
    return canvas


def _chain(experiment: Experiment, data: Data) -> Canvas:
    caption = (
        _caption(experiment, data)
        + " Left: force on each fingertip in one perturbed rollout; grey: the second policy acts."
        " Right: rollouts with at least this number of grip changes while the object stays in"
        " place, from 100 perturbed starts per trial: mean and standard deviation."
    )
    canvas, (left, right) = _canvas(2, caption)
    acting, force = data.measured["acting"], data.measured["force"]
    seconds = 0.1 * np.arange(1, len(acting) + 1)
    for i, finger in enumerate(("index", "middle", "thumb")):
        left.plot(
            seconds, force[:, i], color=_COLOURS[i], linestyle=_DASHES[i], lw=1.3, label=finger
        )
    left.fill_between(
        seconds, 0, 1, where=acting == 1, transform=left.get_xaxis_transform(), color="0.88", lw=0
    )
    left.set(xlabel="time [s]", ylabel="force [N]")
    left.legend(fontsize=8, loc="upper right")
    reached = 100 * data.measured["reached"]
    mean, spread = _spread(reached)
    right.errorbar(
        np.arange(len(mean)), mean, spread, color=_COLOURS[0], marker="o", ms=4, lw=1.3, capsize=2
    )
    right.set(
        xlabel="grip changes", ylabel="rollouts with at least this number [%]", ylim=(-3, 103)
    )
    return canvas


def _kernel(experiment: Experiment, data: Data) -> Canvas:  # noqa: ARG001  one signature for all figures
    caption = (
        "Largest difference between z(x)'z(y) and the Gaussian kernel, over all pairs of 40 states"
        " of d numbers drawn from U(0, 1): mean over draws of the features. Grey: the accuracy for"
        " which table 3.2 of the thesis gives this number."
    )
    canvas, (axis,) = _canvas(1, caption)
    counts = data.measured["features"]
    for i, (size, error) in enumerate(
        zip(data.measured["sizes"].tolist(), data.measured["error"], strict=True)
    ):
        axis.plot(
            counts,
            error,
            color=_COLOURS[i],
            linestyle=_DASHES[i],
            marker=_MARKERS[i],
            ms=4,
            label=f"d {size}",
        )
        accuracies = np.array([0.1, 0.15, 0.2, 0.25, 0.3])
        numbers = [features_for(size, float(eps)) for eps in accuracies]
        axis.plot(
            numbers, accuracies, color="0.6", linestyle=_DASHES[i], lw=1, marker=_MARKERS[i], ms=3
        )
    axis.set(
        xscale="log",
        yscale="log",
        xlabel="number of features D",
        ylabel="largest error of the kernel",
    )
    axis.set_yticks([0.03, 0.1, 0.3, 1.0], ["0.03", "0.1", "0.3", "1"])
    axis.legend(fontsize=8)
    return canvas
