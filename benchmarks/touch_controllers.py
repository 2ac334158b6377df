"""Controllers of the fragile bar's middle finger that are written by hand: blind ones, and one that
feels.

A blind controller reads the joints, whose targets it knows: a servo's deflection measures force.
Each is fitted to rollouts of a cell of `touch_map.py`, that is, to given errors of the sensors.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Final

import numpy as np
from touch import FITS, GRID, STARTS

import farm
from farm.arrays import AnyArray, FloatArray
from farm.runner import Runner
from farm.tasks.finger_gait.fragile_bar import BREAKS, WANTED
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS
from farm.tasks.finger_gait.sensing import ZERO
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Seed
from learner.run.setup import problem

_MIDDLE: Final = FINGER_JOINTS["middle"]
_KEEPS: Final = (0.0, 0.7, 0.9)  # share of the last estimate that a filter keeps
_GAINS: Final = (0.005, 0.01, 0.02, 0.04)  # [rad/N]
_MOST: Final = 0.03  # [rad] per control step
_ANGLES: Final = tuple(np.linspace(0.04, 0.4, 37).tolist())  # [rad]
_WIDTHS: Final = (0.0, 0.02, 0.04, 0.08)  # [rad] around the best fixed angle
# [rad] per control step: how the finger closes in the rollouts of a fit
_WAYS: Final = (0.005, 0.01, 0.02, 0.03)

Cell = Mapping[str, float]


@dataclass
class Played:
    """Rollouts of a controller."""

    success: AnyArray
    """(B,)"""
    deflection: FloatArray
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
        return Played(
            *(
                np.concatenate([getattr(each, name) for each in parts])
                for name in Played.__annotations__
            )
        )


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

    def force(
        self,
        t: int,
        rows: AnyArray,
        deflection: FloatArray,
        move: FloatArray,  # noqa: ARG002
        felt: FloatArray,  # noqa: ARG002
    ) -> FloatArray:
        """The estimated force of some rows (K,) [N], from targets less readings (K, 8) [rad] in
        step t.
        """
        zero, last = self._memory["zero"], self._memory["force"]
        if t < ZERO:
            zero[rows] += deflection / ZERO
            return np.zeros(len(deflection))
        last[rows] = self.keep * last[rows] + (1.0 - self.keep) * (
            self.map[0] + (deflection - zero[rows]) @ self.map[1:]
        )
        return last[rows]

    @classmethod
    def fitted(cls, played: Played, cell: Cell) -> "Iterator[Zeroed]":  # noqa: ARG003
        """With the map that fits best to rollouts, for each filter."""
        zero = played.deflection[:, :ZERO].mean(axis=1, keepdims=True)
        x, force = (played.deflection - zero)[:, ZERO:], played.force[:, ZERO:]
        good = (force < BREAKS) & ~np.isnan(x).any(axis=-1)
        fit = np.linalg.lstsq(np.insert(x[good], 0, 1.0, axis=-1), force[good], rcond=None)[0]
        yield from (cls(fit, keep) for keep in _KEEPS)


@dataclass
class Kalman:
    """A Kalman filter of deflections (8) and errors (8), fitted to rollouts without errors, and a
    linear map to force.

    d' = A d + b u + c + N(0, Q), e' = e + N(0, drift^2), reading = d + e + N(0, noise^2), with the
    finger's motion u.
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

    def force(
        self,
        t: int,
        rows: AnyArray,
        deflection: FloatArray,
        move: FloatArray,
        felt: FloatArray,  # noqa: ARG002
    ) -> FloatArray:
        """The estimated force of some rows (K,) [N]; `move` (K,) is what the last step commanded
        [rad].
        """
        d, e = self._memory["d"][rows], self._memory["e"][rows]
        if t:
            d = d @ self.a.T + move[:, None] * self.b + self.c
        change = (deflection - d - e) @ self.gains[t].T
        self._memory["d"][rows] = d + change[:, : len(JOINTS)]
        self._memory["e"][rows] = e + change[:, len(JOINTS) :]
        return np.asarray(self.map[0] + self._memory["d"][rows] @ self.map[1:])

    @classmethod
    def fitted(cls, played: Played, cell: Cell) -> "Iterator[Kalman]":
        """Fitted to rollouts."""
        d, n = played.true, len(JOINTS)
        good = (played.force < BREAKS) & ~np.isnan(d).any(axis=-1)
        fit = np.asarray(
            np.linalg.lstsq(np.insert(d[good], 0, 1.0, axis=-1), played.force[good], rcond=None)[0],
            float,
        )
        pairs = good[:, 1:] & good[:, :-1]
        before = np.concatenate([d[:, :-1][pairs], played.move[:, :-1][pairs][:, None]], axis=1)
        model, after = np.insert(before, 0, 1.0, axis=1), d[:, 1:][pairs]
        weights = np.asarray(np.linalg.lstsq(model, after, rcond=None)[0], dtype=float)
        a, b, c = weights[1 : 1 + n].T, weights[1 + n], weights[0]
        rest = after - model @ weights
        big = np.block([[a, np.zeros((n, n))], [np.zeros((n, n)), np.eye(n)]])
        noise = np.zeros((2 * n, 2 * n))
        noise[:n, :n], noise[n:, n:] = np.cov(rest.T), cell.get("joint_drift", 0.0) ** 2 * np.eye(n)
        see = np.hstack([np.eye(n), np.eye(n)])
        covariance = (cell.get("joint_noise", 0.01) ** 2 + 1e-10) * np.eye(n)
        p = np.zeros((2 * n, 2 * n))
        # Of the joints' constant error
        p[:n, :n], p[n:, n:] = (np.cov(d[:, 0].T), 0.05**2 / 3.0 * np.eye(n))
        gains = []
        for t in range(d.shape[1]):
            p = big @ p @ big.T + noise if t else p
            gain = p @ see.T @ np.linalg.inv(see @ p @ see.T + covariance)
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

    def force(
        self,
        t: int,  # noqa: ARG002
        rows: AnyArray,
        deflection: FloatArray,  # noqa: ARG002
        move: FloatArray,  # noqa: ARG002
        felt: FloatArray,
    ) -> FloatArray:
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
    runner: Runner,
    starts: Sequence[Seed],
    estimate: Estimate | None,
    gain: float,
    rate: float = 0.0,
    bounds: tuple[float, float] = ANY,
) -> Played:
    """Move the middle finger by gain x (0.9 N - estimated force) per step, or close it at a
    constant rate [rad].

    The sum of its movements stays within bounds [rad], which it approaches as fast as it may.
    """
    size = runner.sim.engine.size
    parts = [starts[i : i + size] for i in range(0, len(starts), size)]
    return Played.joined(
        [again(partial(_once, runner, part, estimate, gain, rate, bounds)) for part in parts]
    )


def _once(
    runner: Runner,
    starts: Sequence[Seed],
    estimate: Estimate | None,
    gain: float,
    rate: float,
    bounds: tuple[float, float],
) -> Played:
    task: Any = runner.task
    batch, sim = Batch(task, runner.sim, tuple(starts)), runner.sim
    deflections, true = (np.full((len(starts), task.steps, len(JOINTS)), np.nan) for _ in range(2))
    move, force = np.zeros((len(starts), task.steps)), np.full((len(starts), task.steps), np.nan)
    if estimate is not None:
        estimate.begin(len(starts))
    while not batch.over:
        rows, t = batch.active, sim.t
        deflections[rows, t] = sim.own["target"] - task.joints(sim)
        true[rows, t] = sim.own["target"] - sim.qpos[:, : len(JOINTS)]
        felt = task.images(sim).sum(axis=-1)[:, FINGERS.index("middle")]
        force[rows, t] = task.measure(sim)["force"].sum(axis=-1)[:, FINGERS.index("middle")]
        step = np.full(len(sim), rate)
        if estimate is not None:
            last = move[rows, t - 1] if t else np.zeros(len(sim))
            step = gain * (WANTED - estimate.force(t, rows, deflections[rows, t], last, felt))
        moved = move[rows].sum(axis=1)
        step = np.clip(np.clip(moved + step, *bounds) - moved, -_MOST, _MOST)
        move[rows, t] = step if t >= ZERO else 0.0
        action = np.zeros((len(sim), len(JOINTS)))
        action[:, _MIDDLE] = move[rows, t][:, None]
        batch.step(action)
    return Played(batch.rollouts().success, deflections, true, move, force)


@cache
def open_loop(stiffness: float) -> tuple[float, int]:
    """With nothing read: by which angle the finger should close [rad], and how many starts that
    succeeds on.
    """
    runner = problem(farm.configure("fragile-bar", stiffness=stiffness)).runner()
    try:
        shares = {
            each: play(runner, GRID, None, 0.0, 0.0, (each, each)).success.mean()
            for each in _ANGLES
        }
        angle = max(shares, key=lambda each: shares[each])
        return angle, int(play(runner, STARTS, None, 0.0, 0.0, (angle, angle)).success.sum())
    finally:
        runner.close()


def by_hand(kinds: Sequence[type[Estimate]], cell: Cell) -> dict[str, Any]:
    """The best controller of these kinds in a cell, and how many of the test's starts it succeeds
    on.
    """
    angle = open_loop(cell.get("stiffness", 1.0))[0]
    runner = problem(farm.configure("fragile-bar", **cell)).runner()
    try:
        closing = [
            play(runner, FITS[i :: len(_WAYS)], None, 0.0, rate) for i, rate in enumerate(_WAYS)
        ]
        candidates: list[tuple[float, str, Estimate, float]] = []
        for kind in kinds:
            data = Played.joined(closing)
            # Then on what it does itself
            second = play(runner, FITS, next(kind.fitted(data, cell)), 0.04)
            for estimate, gain in itertools.product(
                kind.fitted(Played.joined([data, second]), cell), _GAINS
            ):
                part = float(play(runner, GRID, estimate, gain).success.mean())
                candidates.append((part, kind.__name__, estimate, gain))
        free, name, estimate, gain = max(candidates, key=lambda each: each[0])
        bounds = {ANY: free}
        for width in _WIDTHS:
            near = angle - width, angle + width
            bounds[near] = float(play(runner, GRID, estimate, gain, bounds=near).success.mean())
        within = max(bounds, key=lambda each: bounds[each])
        suffix = f", keep {estimate.keep:g}" if isinstance(estimate, Zeroed | Touch) else ""
        return {
            "success": int(play(runner, STARTS, estimate, gain, bounds=within).success.sum()),
            "chosen": f"{name}, gain {gain:g}{suffix}, within {within[0]:g} to {within[1]:g} rad",
        }
    finally:
        runner.close()
