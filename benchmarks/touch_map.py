"""When is touch necessary? A map: success of blind and of feeling controllers over the errors of joint readings.

    python benchmarks/touch_map.py [--fine] [--out docs/results/touch]

The task is the fragile bar. A blind controller reads the joints, whose targets it knows: a servo's deflection measures
force. By hand, in every cell: zeroed deflections with a linear map to the force and a filter, and a Kalman filter; the
better one, with settings chosen for the cell, among them how far the finger may leave the fixed angle that is best with
nothing read. By hand with touch: the same law, with the force that the fingertip reads. Learnt, five seeds of 1280
rollouts with SNES and the weighted kernel: `--state zeroed`, whose width was chosen on seeds 1 and 2, and `--state
forces`, the preset. Everything is fitted and chosen on other starts than the 200 of the test. `--fine` learns in every
cell. Interrupted, the command continues.
"""

import argparse
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from touch import FITS, GRID, STARTS

import farm
from farm.arrays import AnyArray, FloatArray
from farm.rollouts import Runner
from farm.tasks.finger_gait.fragile_bar import BREAKS, WANTED
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS
from farm.tasks.finger_gait.sensing import ZERO
from farm.tasks.loop import Batch, Seed, again
from learner.again.replay import loaded
from learner.run.folder import RunFolder
from learner.run.setup import problem

DRIFTS: Final = (0.0, 0.002, 0.005, 0.01, 0.02)
"""Drift of the joint readings [rad per control step]."""
NOISES: Final = (0.0, 0.01, 0.02, 0.04, 0.08)
"""Noise of the joint readings [rad]."""
STIFFNESSES: Final = (0.5, 2.0, 4.0)
"""Factors of the servos' stiffness, with a noise of 0.01 rad and no drift."""
SKINS: Final[dict[str, dict[str, float]]] = {
    "exact touch": {},
    "good touch": {"force_noise": 0.05, "force_hysteresis": 0.1, "force_dropout": 0.01},
    "poor touch": {"force_noise": 0.2, "force_delay": 1, "force_hysteresis": 0.3, "force_dropout": 0.1},
}
"""Errors of touch."""
SEEDS: Final = (20, 21, 22, 23, 24)
_MIDDLE: Final = FINGER_JOINTS["middle"]
_KEEPS: Final = (0.0, 0.7, 0.9)  # share of the last estimate that a filter keeps
_GAINS: Final = (0.005, 0.01, 0.02, 0.04)  # [rad/N]
_LEARNT: Final = "nothing read, learnt"
_MOST: Final = 0.03  # [rad] per control step
_ANGLES: Final = tuple(np.linspace(0.04, 0.4, 37).tolist())  # [rad]
_WIDTHS: Final = (0.0, 0.02, 0.04, 0.08)  # [rad] around the best fixed angle
_WAYS: Final = (0.005, 0.01, 0.02, 0.03)  # [rad] per control step: how the finger closes in the rollouts of a fit

Cell = Mapping[str, float]


@dataclass
class Played:
    """Rollouts of a controller."""

    success: AnyArray
    """(B,)"""
    seen: FloatArray
    """Targets less joint readings (B, T, 8) [rad], nan after a rollout's end."""
    true: FloatArray
    """The same without errors."""
    move: FloatArray
    """Change of the middle finger's targets (B, T) [rad]."""
    force: FloatArray
    """The middle finger's force (B, T) [N], at the beginning of each step."""

    @staticmethod
    def joined(parts: "Sequence[Played]") -> "Played":
        """Several as one."""
        return Played(*(np.concatenate([getattr(each, name) for each in parts]) for name in Played.__annotations__))


@dataclass
class Zeroed:
    """Deflections less their mean over the first steps, a linear map to the force, and a filter."""

    map: FloatArray
    """(9,)"""
    keep: float
    _memory: dict[str, FloatArray] = field(default_factory=dict)

    def begin(self, count: int) -> None:
        """Start rollouts."""
        self._memory = {"zero": np.zeros((count, len(JOINTS))), "force": np.zeros(count)}

    def force(self, t: int, rows: AnyArray, seen: FloatArray, move: FloatArray, felt: FloatArray) -> FloatArray:  # noqa: ARG002
        """The estimated force of some rows (K,) [N], from targets less readings (K, 8) [rad] in step t."""
        zero, last = self._memory["zero"], self._memory["force"]
        if t < ZERO:
            zero[rows] += seen / ZERO
            return np.zeros(len(seen))
        last[rows] = self.keep * last[rows] + (1.0 - self.keep) * (self.map[0] + (seen - zero[rows]) @ self.map[1:])
        return last[rows]

    @classmethod
    def fitted(cls, played: Played, cell: Cell) -> "Iterator[Zeroed]":  # noqa: ARG003
        """With the map that fits best to rollouts, for each filter."""
        zero = played.seen[:, :ZERO].mean(axis=1, keepdims=True)
        x, force = (played.seen - zero)[:, ZERO:], played.force[:, ZERO:]
        kept = (force < BREAKS) & ~np.isnan(x).any(axis=-1)
        fit = np.linalg.lstsq(np.insert(x[kept], 0, 1.0, axis=-1), force[kept], rcond=None)[0]
        yield from (cls(fit, keep) for keep in _KEEPS)


@dataclass
class Kalman:
    """A Kalman filter of deflections (8) and errors (8), fitted to rollouts without errors, and a linear map to force.

    d' = A d + b u + c + N(0, Q), e' = e + N(0, drift^2), reading = d + e + N(0, noise^2), with the finger's motion u.
    """

    map: FloatArray
    a: FloatArray
    b: FloatArray
    c: FloatArray
    gains: FloatArray
    """(T, 16, 8)"""
    start: FloatArray
    """Mean of d before the first step, (8,)."""
    _memory: dict[str, FloatArray] = field(default_factory=dict)

    def begin(self, count: int) -> None:
        """Start rollouts."""
        self._memory = {"d": np.tile(self.start, (count, 1)), "e": np.zeros((count, len(JOINTS)))}

    def force(self, t: int, rows: AnyArray, seen: FloatArray, move: FloatArray, felt: FloatArray) -> FloatArray:  # noqa: ARG002
        """The estimated force of some rows (K,) [N]; `move` (K,) is what the last step commanded [rad]."""
        d, e = self._memory["d"][rows], self._memory["e"][rows]
        if t:
            d = d @ self.a.T + move[:, None] * self.b + self.c
        change = (seen - d - e) @ self.gains[t].T
        self._memory["d"][rows], self._memory["e"][rows] = d + change[:, : len(JOINTS)], e + change[:, len(JOINTS) :]
        return np.asarray(self.map[0] + self._memory["d"][rows] @ self.map[1:])

    @classmethod
    def fitted(cls, played: Played, cell: Cell) -> "Iterator[Kalman]":
        """Fitted to rollouts."""
        d, n = played.true, len(JOINTS)
        kept = (played.force < BREAKS) & ~np.isnan(d).any(axis=-1)
        fit = np.asarray(np.linalg.lstsq(np.insert(d[kept], 0, 1.0, axis=-1), played.force[kept], rcond=None)[0], float)
        pairs = kept[:, 1:] & kept[:, :-1]
        before = np.concatenate([d[:, :-1][pairs], played.move[:, :-1][pairs][:, None]], axis=1)
        model, after = np.insert(before, 0, 1.0, axis=1), d[:, 1:][pairs]
        found = np.asarray(np.linalg.lstsq(model, after, rcond=None)[0], dtype=float)
        a, b, c = found[1 : 1 + n].T, found[1 + n], found[0]
        rest = after - model @ found
        big = np.block([[a, np.zeros((n, n))], [np.zeros((n, n)), np.eye(n)]])
        noise = np.zeros((2 * n, 2 * n))
        noise[:n, :n], noise[n:, n:] = np.cov(rest.T), cell.get("joint_drift", 0.0) ** 2 * np.eye(n)
        see, read = np.hstack([np.eye(n), np.eye(n)]), (cell.get("joint_noise", 0.01) ** 2 + 1e-10) * np.eye(n)
        p = np.zeros((2 * n, 2 * n))
        p[:n, :n], p[n:, n:] = np.cov(d[:, 0].T), 0.05**2 / 3.0 * np.eye(n)  # of the joints' constant error
        gains = []
        for t in range(d.shape[1]):
            p = big @ p @ big.T + noise if t else p
            gain = p @ see.T @ np.linalg.inv(see @ p @ see.T + read)
            p = p - gain @ see @ p
            gains.append(gain)
        yield cls(fit, a, b, c, np.stack(gains), d[:, 0].mean(axis=0))


@dataclass
class Touch:
    """The force that the fingertip reads, and a filter."""

    keep: float
    _memory: dict[str, FloatArray] = field(default_factory=dict)

    def begin(self, count: int) -> None:
        """Start rollouts."""
        self._memory = {"force": np.zeros(count)}

    def force(self, t: int, rows: AnyArray, seen: FloatArray, move: FloatArray, felt: FloatArray) -> FloatArray:  # noqa: ARG002
        """The read force of some rows (K,) [N]."""
        last = self._memory["force"]
        last[rows] = self.keep * last[rows] + (1.0 - self.keep) * felt
        return last[rows]

    @classmethod
    def fitted(cls, played: Played, cell: Cell) -> "Iterator[Touch]":  # noqa: ARG003
        """With each filter."""
        yield from (cls(keep) for keep in _KEEPS)


Estimate = Zeroed | Kalman | Touch


ANY: Final = (-np.inf, np.inf)
"""No bounds."""


def play(
    runner: Runner, starts: Sequence[Seed], estimate: Estimate | None, gain: float, rate: float = 0.0,
    bounds: tuple[float, float] = ANY,
) -> Played:  # fmt: skip
    """Move the middle finger by gain x (0.9 N - estimated force) per step, or close it at a constant rate [rad].

    The sum of its movements stays within bounds [rad], which it approaches as fast as it may.
    """
    size = runner.sim.engine.size
    parts = [starts[i : i + size] for i in range(0, len(starts), size)]
    return Played.joined([again(partial(_once, runner, part, estimate, gain, rate, bounds)) for part in parts])


def _once(
    runner: Runner, starts: Sequence[Seed], estimate: Estimate | None, gain: float, rate: float,
    bounds: tuple[float, float],
) -> Played:  # fmt: skip
    task: Any = runner.task
    batch, sim = Batch(task, runner.sim, tuple(starts)), runner.sim
    seen, true = (np.full((len(starts), task.steps, len(JOINTS)), np.nan) for _ in range(2))
    move, force = np.zeros((len(starts), task.steps)), np.full((len(starts), task.steps), np.nan)
    if estimate is not None:
        estimate.begin(len(starts))
    while not batch.over:
        rows, t = batch.active, sim.t
        seen[rows, t] = sim.own["target"] - task.joints(sim)
        true[rows, t] = sim.own["target"] - sim.qpos[:, : len(JOINTS)]
        felt = task.images(sim).sum(axis=-1)[:, FINGERS.index("middle")]
        force[rows, t] = task.measure(sim)["force"].sum(axis=-1)[:, FINGERS.index("middle")]
        step = np.full(len(sim), rate)
        if estimate is not None:
            last = move[rows, t - 1] if t else np.zeros(len(sim))
            step = gain * (WANTED - estimate.force(t, rows, seen[rows, t], last, felt))
        moved = move[rows].sum(axis=1)
        step = np.clip(np.clip(moved + step, *bounds) - moved, -_MOST, _MOST)
        move[rows, t] = step if t >= ZERO else 0.0
        action = np.zeros((len(sim), len(JOINTS)))
        action[:, _MIDDLE] = move[rows, t][:, None]
        batch.step(action)
    return Played(batch.rollouts().success, seen, true, move, force)


@cache
def open_loop(stiffness: float) -> tuple[float, int]:
    """With nothing read: by which angle the finger should close [rad], and how many starts that succeeds on."""
    runner = problem(farm.configure("fragile-bar", stiffness=stiffness)).runner()
    try:
        shares = {each: play(runner, GRID, None, 0.0, 0.0, (each, each)).success.mean() for each in _ANGLES}
        angle = max(shares, key=lambda each: shares[each])
        return angle, int(play(runner, STARTS, None, 0.0, 0.0, (angle, angle)).success.sum())
    finally:
        runner.close()


def by_hand(kinds: Sequence[type[Estimate]], cell: Cell) -> dict[str, Any]:
    """The best controller of these kinds in a cell, and how many of the test's starts it succeeds on."""
    angle, runner = open_loop(cell.get("stiffness", 1.0))[0], problem(farm.configure("fragile-bar", **cell)).runner()
    try:
        closing = [play(runner, FITS[i :: len(_WAYS)], None, 0.0, rate) for i, rate in enumerate(_WAYS)]
        found: list[tuple[float, str, Estimate, float]] = []
        for kind in kinds:
            data = Played.joined(closing)
            own = play(runner, FITS, next(kind.fitted(data, cell)), 0.04)  # then on what it does itself
            for estimate, gain in itertools.product(kind.fitted(Played.joined([data, own]), cell), _GAINS):
                part = float(play(runner, GRID, estimate, gain).success.mean())
                found.append((part, kind.__name__, estimate, gain))
        free, name, estimate, gain = max(found, key=lambda each: each[0])
        bounds = {ANY: free}
        for width in _WIDTHS:
            near = angle - width, angle + width
            bounds[near] = float(play(runner, GRID, estimate, gain, bounds=near).success.mean())
        within = max(bounds, key=lambda each: bounds[each])
        kept = f", keep {estimate.keep:g}" if isinstance(estimate, Zeroed | Touch) else ""
        return {
            "success": int(play(runner, STARTS, estimate, gain, bounds=within).success.sum()),
            "chosen": f"{name}, gain {gain:g}{kept}, within {within[0]:g} to {within[1]:g} rad",
        }
    finally:
        runner.close()


def learnt(state: str, cell: Cell, width: float, seed: int) -> int:
    """Learn a run, or continue it; on how many of the test's starts its policy succeeds."""
    from running import learn  # workers load this file by its path alone

    config = farm.configure("fragile-bar", state=state, width=width, seed=seed, **cell)
    folder = Path("runs/touch-map", "-".join([state, *(f"{k}-{v:g}" for k, v in sorted(cell.items())), f"s{seed}"]))
    learn(config, folder, workers=2)
    runner, mu = problem(config).runner(), loaded(RunFolder.open(folder)).mu
    size = runner.sim.engine.size
    parts = [STARTS[i : i + size] for i in range(0, len(STARTS), size)]
    try:
        return int(sum(runner.rollouts(np.tile(mu, (len(part), 1)), part).success.sum() for part in parts))
    finally:
        runner.close()


def cells() -> list[dict[str, float]]:
    """All cells: drift x noise, then stiffness."""
    square = [{"joint_drift": drift, "joint_noise": noise} for drift in DRIFTS for noise in NOISES]
    return [*square, *({"joint_drift": 0.0, "joint_noise": 0.01, "stiffness": factor} for factor in STIFFNESSES)]


def on_the_axes(cell: Cell) -> bool:
    """Whether a cell has the nominal noise or no drift."""
    return cell["joint_noise"] == 0.01 or cell["joint_drift"] == 0.0


def tasks(*, fine: bool) -> Iterator[tuple[str, Callable[[], Any]]]:
    """What is to be computed, by name."""
    for cell in cells():
        name = _name(cell)
        yield f"blind by hand, {name}", partial(by_hand, (Zeroed, Kalman), cell)
    stiffer: list[dict[str, float]] = [{}, *({"stiffness": factor} for factor in STIFFNESSES)]
    for extra in stiffer:
        yield f"nothing read, {_name(extra)}", partial(_unread, extra)
    yield _LEARNT, _unread_learnt
    for skin, errors in SKINS.items():
        for extra in stiffer:
            yield f"{skin} by hand, {_name(extra)}", partial(by_hand, (Touch,), {**errors, **extra})
        for seed in SEEDS:
            yield f"{skin} learnt, seed {seed}", partial(learnt, "forces", errors, 0.4, seed)
    for cell in cells():
        for seed in SEEDS if fine or on_the_axes(cell) else ():
            yield f"blind learnt, {_name(cell)}, seed {seed}", partial(learnt, "zeroed", cell, _width(cell), seed)


def wilson(count: float, n: int = len(STARTS), z: float = 1.96) -> tuple[float, float]:
    """The 95 % interval of a share, by Wilson's score (Wilson 1927)."""
    p, scale = count / n, 1.0 + z * z / n
    middle, half = (p + z * z / (2 * n)) / scale, z / scale * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return float(middle - half), float(middle + half)


def least(more: float, less: float, n: int = len(STARTS)) -> float:
    """The lower end of the 95 % interval of the difference of two shares (Newcombe 1998, method 10)."""
    p, q = more / n, less / n
    return float(p - q - np.sqrt((p - wilson(more, n)[0]) ** 2 + (wilson(less, n)[1] - q) ** 2))


def best(found: Mapping[str, Any], cell: Cell) -> int:
    """The most starts on which anything blind that was tried succeeds, lucky seeds included."""
    own = {key: value for key, value in cell.items() if key == "stiffness"}
    seeds = [found[name] for name in found if name.startswith(f"blind learnt, {_name(cell)}, seed")]
    unread = [found[f"nothing read, {_name(own)}"], *([] if own else [found[_LEARNT]])]
    return max(found[f"blind by hand, {_name(cell)}"]["success"], *unread, *seeds)


def tables(found: Mapping[str, Any]) -> str:
    """The page's tables."""
    n, lines = len(STARTS), [f"| drift \\ noise [rad] | {' | '.join(f'{each:g}' for each in NOISES)} |"]
    lines.append("|---" * (1 + len(NOISES)) + "|")
    good = found["good touch by hand, nominal"]["success"]
    for drift in DRIFTS:
        row = []
        for noise in NOISES:
            cell = {"joint_drift": drift, "joint_noise": noise}
            seeds = [found[name] for name in found if name.startswith(f"blind learnt, {_name(cell)}, seed")]
            learnt = f" ({100 * np.median(seeds) / n:.0f})" if seeds else ""
            row.append(f"{100 * best(found, cell) / n:.0f}{learnt}, {100 * least(good, best(found, cell)):+.0f}")
        lines.append(f"| {drift:g} | {' | '.join(row)} |")
    lines += ["", "| stiffness | blind | exact touch | good touch | poor touch | nothing read |", "|---" * 6 + "|"]
    for factor in sorted({1.0, *STIFFNESSES}):
        own = {} if factor == 1.0 else {"stiffness": factor}
        hands = [found[f"{skin} by hand, {_name(own)}"]["success"] for skin in SKINS]
        counts = [
            best(found, {"joint_drift": 0.0, "joint_noise": 0.01, **own}), *hands,
            found[f"nothing read, {_name(own)}"],
        ]  # fmt: skip
        lines.append(f"| {factor:g} | {' | '.join(f'{100 * count / n:.0f}' for count in counts)} |")
    lines += ["", "| learnt with | success by seed [%] |", "|---|---|"]
    for skin in SKINS:
        shares = (found[f"{skin} learnt, seed {seed}"] / n for seed in SEEDS)
        lines.append(f"| {skin} | {', '.join(f'{100 * share:.3g}' for share in shares)} |")
    return "\n".join(lines) + "\n"


def draw(found: Mapping[str, Any], path: Path) -> None:
    """The map: blind success by drift and noise; and beside it, along the drift, what touch reaches."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    n = len(STARTS)
    square = np.array([[best(found, {"joint_drift": d, "joint_noise": s}) for s in NOISES] for d in DRIFTS]) / n
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
    along = [best(found, {"joint_drift": drift, "joint_noise": 0.01}) for drift in DRIFTS]
    shares = np.array(along) / n
    bounds = np.array([wilson(count) for count in along])
    right.errorbar(
        range(len(DRIFTS)), 100 * shares, yerr=100 * np.abs(bounds - shares[:, None]).T, fmt="o-", color="#555555",
        capsize=3, label="without touch",
    )  # fmt: skip
    for skin, colour, width in zip(SKINS, ("#0072b2", "#009e73", "#d55e00"), (6, 3.5, 1.2), strict=True):
        share = found[f"{skin} by hand, nominal"]["success"] / n
        right.axhline(100 * share, color=colour, linewidth=width, label=skin)
    right.axhline(100 * found[_LEARNT] / n, color="#999999", linestyle=":", label="nothing read")
    right.set_xticks(range(len(DRIFTS)), [f"{each:g}" for each in DRIFTS])
    right.set_ylim(0, 103)
    right.set_xlabel("drift of joint readings [rad per step], noise 0.01 rad")
    right.set_ylabel("success [%]")
    right.legend(loc="lower left", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def _width(cell: Cell) -> float:
    """Of the kernel for zeroed deflections: it grows with the readings' errors, by which they are spread."""
    return max(1.0, 2.0 * float(np.sqrt(cell["joint_noise"] ** 2 + 12.0 * cell["joint_drift"] ** 2)) / 0.01)


def _unread_learnt() -> int:
    """The best of ten policies of `touch.py` that read nothing: constant targets of all joints, functions of time."""
    rows = json.loads((Path(__file__).parents[1] / "docs/results/touch/bias-0.05.json").read_text("utf-8"))
    names = ("constant", "constant, last mean", "time", "time, last mean")
    return round(len(STARTS) * max(max(rows[name]) for name in names))


def _unread(cell: Cell) -> int:
    return open_loop(cell.get("stiffness", 1.0))[1]


def _name(cell: Cell) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value:g}" for key, value in cell.items()) or "nominal"


def main() -> None:
    """Compute what is missing, and write it down."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fine", action="store_true", help="learn in every cell")
    parser.add_argument("--out", type=Path, default=Path("docs/results/touch"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "map.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    for name, compute in tasks(fine=arguments.fine):
        if name not in found:
            found[name] = compute()
            path.write_text(json.dumps(found, indent=1) + "\n")
            print(name, found[name], flush=True)
    draw(found, arguments.out / "map.png")
    print(tables(found), end="")


if __name__ == "__main__":
    from running import script

    script(main)
