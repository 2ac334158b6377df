"""When is touch necessary?

A map: success of blind and of feeling controllers over the errors of joint readings.

    python benchmarks/touch_map.py [--fine] [--connect ROUTER] [--out docs/results/touch]

The task is the fragile bar. By hand (`touch_controllers.py`), in every cell: zeroed deflections
with a linear map to the force and a filter, and a Kalman filter; the better one, with settings
chosen for the cell, among them how far the finger may leave the fixed angle that is best with
nothing read. By hand with touch: the same law, with the force that the fingertip reads. Learnt,
five seeds of 1280 rollouts with SNES: `--state zeroed` with the weighted kernel, whose width was
chosen on seeds 1 and 2; `--state forces`, the preset; constant targets; and networks with a memory
(`--policy rnn`), with settings chosen on seeds 1 and 2. Everything is fitted and chosen on other
starts than the 200 of the test. `--fine` learns in every cell. The runs are learnt as by `farm
sweep`, here or on the farm of a router. Interrupted, the command continues.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import learn_together
from touch import EXACT, STARTS
from touch_controllers import Cell, Kalman, Touch, Zeroed, by_hand, open_loop

import farm
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.tools.replay.loaded import loaded
from learner.tools.sweep.runs import Sharing

DRIFTS: Final = (0.0, 0.002, 0.005, 0.01, 0.02)
"""Drift of the joint readings [rad per control step]."""
NOISES: Final = (0.0, 0.01, 0.02, 0.04, 0.08)
"""Noise of the joint readings [rad]."""
STIFFNESSES: Final = (0.5, 2.0, 4.0)
"""Factors of the servos' stiffness, with a noise of 0.01 rad and no drift."""
SKINS: Final[dict[str, dict[str, float]]] = {
    "exact touch": EXACT,
    "good touch": {"force_noise": 0.05, "force_hysteresis": 0.1, "force_dropout": 0.01},
    "poor touch": {
        "force_noise": 0.2,
        "force_delay": 1,
        "force_hysteresis": 0.3,
        "force_dropout": 0.1,
    },
}
"""Errors of touch."""
STIFFER: Final[tuple[dict[str, float], ...]] = tuple(
    {"stiffness": factor} for factor in STIFFNESSES
)
CONSTANT: Final[dict[str, Any]] = {
    "policy": "constant",
    "state": "joints",
    "action": "offset",
    "initial_sigma": 0.3,
}
"""The best constant targets of all joints; settings as in `touch.py`."""
REMEMBERED: Final[tuple[dict[str, float], ...]] = tuple(
    {"joint_drift": drift, "joint_noise": 0.01} for drift in (0.0, 0.005, 0.01)
)
"""Cells in which networks with a memory are learnt as well."""
MEMORY: Final[dict[str, Any]] = {
    "state": "joints",
    "action": "offset",
    "units": 4,
    "initial_sigma": 0.05,
}
SEEDS: Final = (20, 21, 22, 23, 24)
RUNS: Final = Path("runs/touch-map")
_LEARNT: Final = "nothing read, learnt"


Learnt = tuple[Path, RunConfig]
"""A run's folder and configuration."""


def learnt(name: str, cell: Cell, seed: int, **settings: Any) -> Learnt:  # noqa: ANN401
    """A run that learns in a cell."""
    folder = "-".join(
        [name, *(f"{key}-{value:g}" for key, value in sorted(cell.items())), f"s{seed}"]
    )
    return RUNS / folder, farm.configure("fragile-bar", seed=seed, **settings, **cell)


def successes(folder: Path, config: RunConfig) -> int:
    """On how many of the test's starts a learnt policy succeeds."""
    runner, mu = problem(config).runner(), loaded(RunFolder.open(folder)).mu
    size = runner.sim.engine.size
    parts = [STARTS[i : i + size] for i in range(0, len(STARTS), size)]
    try:
        return int(
            sum(runner.rollouts(np.tile(mu, (len(part), 1)), part).success.sum() for part in parts)
        )
    finally:
        runner.close()


def cells() -> list[dict[str, float]]:
    """All cells: drift x noise, then stiffness."""
    square = [{"joint_drift": drift, "joint_noise": noise} for drift in DRIFTS for noise in NOISES]
    return [
        *square,
        *({"joint_drift": 0.0, "joint_noise": 0.01, "stiffness": factor} for factor in STIFFNESSES),
    ]


def on_the_axes(cell: Cell) -> bool:
    """Whether a cell has the nominal noise or no drift."""
    return cell["joint_noise"] == 0.01 or cell["joint_drift"] == 0.0


def runs(*, fine: bool) -> Iterator[tuple[str, Learnt]]:
    """What is to be learnt, by name."""
    for seed in SEEDS:
        for skin, errors in SKINS.items():
            yield (
                f"{skin} learnt, seed {seed}",
                learnt("forces", errors, seed, state="forces", width=0.4),
            )
        for extra in STIFFER:
            run = learnt("constant", extra, seed, **CONSTANT)
            yield f"nothing read, learnt, {_name(extra)}, seed {seed}", run
            errors = SKINS["good touch"] | extra
            run = learnt("forces", errors, seed, state="forces", width=0.4)
            yield f"good touch learnt, {_name(extra)}, seed {seed}", run
        for cell in REMEMBERED:
            run = learnt("rnn", cell, seed, policy="rnn", **MEMORY)
            yield f"blind learnt, {_name(cell)}, with memory, seed {seed}", run
        for cell in cells():
            if fine or on_the_axes(cell):
                run = learnt("zeroed", cell, seed, state="zeroed", width=_width(cell))
                yield f"blind learnt, {_name(cell)}, seed {seed}", run


def programs() -> Iterator[tuple[str, Callable[[], Any]]]:
    """What is computed without learning, by name."""
    for cell in cells():
        yield f"blind by hand, {_name(cell)}", partial(by_hand, (Zeroed, Kalman), cell)
    yield _LEARNT, _unread_learnt
    for extra in ({}, *STIFFER):
        yield f"nothing read, {_name(extra)}", partial(_unread, extra)
        for skin, errors in SKINS.items():
            yield f"{skin} by hand, {_name(extra)}", partial(by_hand, (Touch,), {**errors, **extra})


def wilson(count: float, n: int = len(STARTS), z: float = 1.96) -> tuple[float, float]:
    """The 95 % interval of a share, by Wilson's score (Wilson 1927)."""
    p, scale = count / n, 1.0 + z * z / n
    middle = (p + z * z / (2 * n)) / scale
    half = z / scale * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return float(middle - half), float(middle + half)


def least(more: float, less: float, n: int = len(STARTS)) -> float:
    """The lower end of the 95 % interval of the difference of two shares (Newcombe 1998, method
    10).
    """
    p, q = more / n, less / n
    return float(p - q - np.sqrt((p - wilson(more, n)[0]) ** 2 + (wilson(less, n)[1] - q) ** 2))


def best(results: Mapping[str, Any], cell: Cell) -> int:
    """The most starts on which anything blind that was tried succeeds, lucky seeds included."""
    stiffness = {key: value for key, value in cell.items() if key == "stiffness"}
    seeds = [results[name] for name in results if name.startswith(f"blind learnt, {_name(cell)}, ")]
    unread = [results[f"nothing read, {_name(stiffness)}"], _unread_best(results, stiffness)]
    return max(results[f"blind by hand, {_name(cell)}"]["success"], *unread, *seeds)


def _unread_best(results: Mapping[str, Any], extra: Mapping[str, float]) -> int:
    """The best learnt policy that reads nothing, lucky seeds included."""
    seeds = [
        results[name]
        for name in results
        if name.startswith(f"nothing read, learnt, {_name(extra)}, ")
    ]
    return max(seeds, default=0) if extra else int(results[_LEARNT])


def tables(results: Mapping[str, Any]) -> str:
    """The page's tables."""
    n = len(STARTS)
    lines = [f"| drift \\ noise [rad] | {' | '.join(f'{each:g}' for each in NOISES)} |"]
    lines.append("|---" * (1 + len(NOISES)) + "|")
    good = results["good touch by hand, nominal"]["success"]
    for drift in DRIFTS:
        row = []
        for noise in NOISES:
            cell = {"joint_drift": drift, "joint_noise": noise}
            seeds = [
                results[name]
                for name in results
                if name.startswith(f"blind learnt, {_name(cell)}, seed")
            ]
            learnt = f" ({100 * np.median(seeds) / n:.0f})" if seeds else ""
            row.append(
                f"{100 * best(results, cell) / n:.0f}{learnt},"
                f" {100 * least(good, best(results, cell)):+.0f}"
            )
        lines.append(f"| {drift:g} | {' | '.join(row)} |")
    heads = [
        "stiffness",
        "blind",
        *SKINS,
        "good touch, learnt",
        "good touch adds at least",
        "best fixed angle",
    ]
    lines += ["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for factor in sorted({1.0, *STIFFNESSES}):
        stiffness = {} if factor == 1.0 else {"stiffness": factor}
        hands = [results[f"{skin} by hand, {_name(stiffness)}"]["success"] for skin in SKINS]
        blind = best(results, {"joint_drift": 0.0, "joint_noise": 0.01, **stiffness})
        learnt = _median(
            results, f"good touch learnt, {_name(stiffness)}" if stiffness else "good touch learnt"
        )
        cells = [
            *(_percent(count) for count in (blind, *hands, learnt)),
            f"{100 * least(max(hands[1], learnt), blind):+.0f}",
        ]
        lines.append(
            f"| {factor:g} |"
            f" {' | '.join([*cells, _percent(results[f'nothing read, {_name(stiffness)}'])])} |"
        )
    lines += ["", "| learnt with | success by seed [%] |", "|---|---|"]
    rows = {skin: f"{skin} learnt" for skin in SKINS}
    rows |= {
        f"good touch, stiffness {extra['stiffness']:g}": f"good touch learnt, {_name(extra)}"
        for extra in STIFFER
    }
    rows |= {
        f"nothing read, stiffness {extra['stiffness']:g}": f"nothing read, learnt, {_name(extra)}"
        for extra in STIFFER
    }
    rows |= {
        f"memory, without touch, drift {cell['joint_drift']:g}": (
            f"blind learnt, {_name(cell)}, with memory"
        )
        for cell in REMEMBERED
    }
    for head, name in rows.items():
        shares = [
            results[f"{name}, seed {seed}"] / n
            for seed in SEEDS
            if f"{name}, seed {seed}" in results
        ]
        if shares:
            lines.append(f"| {head} | {', '.join(f'{100 * share:.3g}' for share in shares)} |")
    return "\n".join(lines) + "\n"


def _median(results: Mapping[str, Any], name: str) -> int:
    """Of the seeds that have been learnt."""
    seeds = [results[f"{name}, seed {seed}"] for seed in SEEDS if f"{name}, seed {seed}" in results]
    return int(np.median(seeds)) if seeds else 0


def _percent(count: int) -> str:
    return f"{100 * count / len(STARTS):.0f}"


def draw(results: Mapping[str, Any], path: Path) -> None:
    """The map: blind success by drift and noise; and beside it, along the drift, what touch
    reaches.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    n = len(STARTS)
    square = (
        np.array(
            [[best(results, {"joint_drift": d, "joint_noise": s}) for s in NOISES] for d in DRIFTS]
        )
        / n
    )
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), width_ratios=(1.1, 1))
    left.imshow(square, origin="lower", cmap="viridis", vmin=0.4, vmax=1.0, aspect="auto")
    for (row, column), share in np.ndenumerate(square):
        colour = "black" if share > 0.75 else "white"
        left.text(column, row, f"{100 * share:.0f} %", ha="center", va="center", color=colour)
    left.text(0, -0.28, "12-bit\nencoders", ha="center", va="center", fontsize=7)
    left.set_xticks(range(len(NOISES)), [f"{each:g}" for each in NOISES])
    left.set_yticks(range(len(DRIFTS)), [f"{each:g}" for each in DRIFTS])
    left.set_xlabel("noise of joint readings [rad]")
    left.set_ylabel("drift of joint readings [rad per step]")
    left.set_title("best success without touch")
    along = [best(results, {"joint_drift": drift, "joint_noise": 0.01}) for drift in DRIFTS]
    shares = np.array(along) / n
    bounds = np.array([wilson(count) for count in along])
    right.errorbar(
        range(len(DRIFTS)),
        100 * shares,
        yerr=100 * np.abs(bounds - shares[:, None]).T,
        fmt="o-",
        color="#555555",
        capsize=3,
        label="without touch",
    )
    for skin, colour, width in zip(
        SKINS, ("#0072b2", "#009e73", "#d55e00"), (6, 3.5, 1.2), strict=True
    ):
        share = results[f"{skin} by hand, nominal"]["success"] / n
        right.axhline(100 * share, color=colour, linewidth=width, label=skin)
    right.axhline(100 * results[_LEARNT] / n, color="#999999", linestyle=":", label="nothing read")
    right.set_xticks(range(len(DRIFTS)), [f"{each:g}" for each in DRIFTS])
    right.set_ylim(0, 103)
    right.set_xlabel("drift of joint readings [rad per step], noise 0.01 rad")
    right.set_ylabel("success [%]")
    right.legend(loc="lower left", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def _width(cell: Cell) -> float:
    """Of the kernel for zeroed deflections: it grows with the readings' errors, by which they are
    spread.
    """
    return max(
        1.0, 2.0 * float(np.sqrt(cell["joint_noise"] ** 2 + 12.0 * cell["joint_drift"] ** 2)) / 0.01
    )


def _unread_learnt() -> int:
    """The best of ten policies of `touch.py` that read nothing: constant targets of all joints,
    functions of time.
    """
    rows = json.loads(
        (Path(__file__).parents[1] / "docs/results/touch/bias-0.05.json").read_text("utf-8")
    )
    names = ("constant", "constant, last mean", "time", "time, last mean")
    return round(len(STARTS) * max(max(rows[name]) for name in names))


def _unread(cell: Cell) -> int:
    return open_loop(cell.get("stiffness", 1.0))[1]


def _name(cell: Cell) -> str:
    return (
        ", ".join(f"{key.replace('_', ' ')} {value:g}" for key, value in cell.items()) or "nominal"
    )


def main() -> None:
    """Compute what is missing, and write it down."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fine", action="store_true", help="learn in every cell")
    parser.add_argument("--out", type=Path, default=Path("docs/results/touch"))
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        help="learn on the farm of this router; repeatable",
    )
    parser.add_argument(
        "--tls", type=Path, help="the learner's certificates, for --connect tls/..."
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "map.json"
    results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    todo = {name: run for name, run in runs(fine=arguments.fine) if name not in results}
    learn_together(
        dict(todo.values()), RUNS, Sharing(connect=tuple(arguments.connect), tls=arguments.tls)
    )
    for name, compute in (
        *((name, partial(successes, *run)) for name, run in todo.items()),
        *programs(),
    ):
        if name not in results:
            results[name] = compute()
            path.write_text(json.dumps(results, indent=1) + "\n")
            print(name, results[name], flush=True)
    draw(results, arguments.out / "map.png")
    print(tables(results), end="")


if __name__ == "__main__":
    from running import script

    script(main)
