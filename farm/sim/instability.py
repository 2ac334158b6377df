"""Why a simulation becomes unstable: how its model starts, what its joints lack, which of them left
first.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.sim.engines import STATE, BatchEngine
from farm.sim.sim import LIMIT

_INSIDE: Final = 0.05  # share of the smaller geometry's radius
_LEAST_INSIDE: Final = 1e-3  # [m]; resting contacts are less deep
_BEYOND: Final = 0.01  # share of a joint's range
_HINGE: Final = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE: Final = int(mujoco.mjtJoint.mjJNT_SLIDE)
_ARMATURE: Final = 0.01  # [kg m^2] or [kg]
_DAMPING: Final = 0.1  # [N m s / rad] or [N s / m]
_FINER: Final = 5
_MOST: Final = 3  # findings of a kind that are named


@dataclass(frozen=True)
class Remedy:
    """A change of a model that may keep its simulation stable."""

    words: str
    change: Callable[[mujoco.MjModel], None]
    finer: int = 1
    """Number of physics steps that replace one."""


def remedies(model: mujoco.MjModel) -> list[Remedy]:
    """The changes that fit a model."""
    bare = len(bare_dofs(model))
    heavy = (
        f'armature="{_ARMATURE:g}" and damping="{_DAMPING:g}" for each joint that has neither'
        f" ({bare})"
    )
    step = model.opt.timestep / _FINER
    changes = [
        Remedy(f"a timestep of {step:g} s", _finer, _FINER),
        *([Remedy(heavy, _heavier)] if bare else []),
    ]
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        changes.append(Remedy('<option integrator="implicitfast"/>', _implicit))
    return changes


def _finer(model: mujoco.MjModel) -> None:
    model.opt.timestep /= _FINER


def _implicit(model: mujoco.MjModel) -> None:
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _heavier(model: mujoco.MjModel) -> None:
    dofs = bare_dofs(model)
    model.dof_armature[dofs] = _ARMATURE
    model.dof_damping[dofs] = _DAMPING


@dataclass(frozen=True)
class Unstable:
    """A row of an engine before the call in which it became unstable."""

    state: FloatArray
    """Integration state of the row, with the controls."""
    steps: int
    """Physics steps of the call."""


class WatchedEngine(BatchEngine):
    """An engine that keeps the state from which its first row became unstable."""

    first: Unstable | None = None

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""
        before = self._batch.state[ids].copy() if self.first is None else None
        super().step(ids, count)
        if before is not None and (diverged := self.blown_up(ids)).any():
            self.first = Unstable(before[int(diverged.argmax())], count)


def first_joint(model: mujoco.MjModel, unstable: Unstable) -> str:
    """The joint that left first, in words; empty if the simulation of this state alone stays
    stable.
    """
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, unstable.state, STATE)
    for _ in range(unstable.steps):
        before = np.abs(data.qvel).copy()
        try:
            mujoco.mj_step(model, data)
        except mujoco.FatalError:
            return ""
        speed = np.abs(data.qvel)
        bad = ~(speed < LIMIT)
        if bad.any() or not (np.abs(data.qpos) < LIMIT).all():
            fastest = int(
                np.nan_to_num(
                    before if not bad.any() else np.where(bad, before + 1.0, 0.0)
                ).argmax()
            )
            return _joint(model, int(model.dof_jntid[fastest]))
    return ""


def outside(model: mujoco.MjModel, qpos: FloatArray) -> list[str]:
    """Joints that start outside their ranges, in words; positions (B, nq) at the starts."""
    complaints = []
    for joint in np.flatnonzero(model.jnt_limited).tolist():
        kind = int(model.jnt_type[joint])
        if kind not in (_HINGE, _SLIDE):
            continue
        low, high = model.jnt_range[joint]
        values = qpos[:, model.jnt_qposadr[joint]]
        beyond = np.maximum(low - values, values - high)
        row = int(beyond.argmax())
        if beyond[row] > _BEYOND * (high - low):
            unit = "rad" if kind == _HINGE else "m"
            value = float(values[row])
            degrees = unit == "rad" and low <= np.radians(value) <= high
            hint = f": {np.radians(value):.3g} rad, if degrees were meant" if degrees else ""
            complaints.append(
                f"{_joint(model, joint)} starts at {value:.3g} {unit}, outside {low:.3g} to"
                f" {high:.3g}{hint}"
            )
    return complaints[:_MOST]


def overlapping(model: mujoco.MjModel, qpos: FloatArray, mocap: FloatArray | None) -> list[str]:
    """Bodies that begin inside each other, in words, the deepest first.

    Args:
      model: the model.
      qpos: positions at one start, (nq,).
      mocap: poses of its mocap bodies, (nmocap, 7); None without any.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    if mocap is not None:
        data.mocap_pos[:] = mocap[:, :3]
        data.mocap_quat[:] = mocap[:, 3:]
    try:
        mujoco.mj_fwdPosition(model, data)
    except mujoco.FatalError:
        return []
    deepest: dict[tuple[str, str], float] = {}
    for contact in data.contact:
        radii = [
            radius for geom in contact.geom if (radius := float(model.geom_rbound[geom])) > 0.0
        ]
        if -contact.dist > max(_LEAST_INSIDE, _INSIDE * min(radii, default=0.0)):
            first, second = (_body(model, int(model.geom_bodyid[geom])) for geom in contact.geom)
            deepest[first, second] = max(deepest.get((first, second), 0.0), -float(contact.dist))
    order = sorted(deepest.items(), key=lambda item: -item[1])
    return [
        f"{one} and {other} begin {1e3 * depth:.3g} mm inside each other"
        for (one, other), depth in order[:_MOST]
    ]


def too_stiff(model: mujoco.MjModel) -> list[str]:
    """Joints whose springs and servos swing too fast for the timestep, in words, the stiffest
    first.

    A mass m on a spring k, stepped by semi-implicit Euler, is stable while timestep sqrt(k / m) < 2
    (Hairer, Lubich & Wanner 2006, Geometric numerical integration, I.5); joints above half of that
    are named. m is the diagonal of the inertia matrix in the model's reference pose.
    """
    stiffness = np.zeros(model.nv)
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            stiffness[model.jnt_dofadr[joint]] += np.ravel(model.jnt_stiffness[joint])[0]
    for actuator in range(model.nu):
        at_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        if at_joint and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
            dof = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
            gear = model.actuator_gear[actuator, 0]
            stiffness[dof] -= model.actuator_biasprm[actuator, 1] * gear * gear
    rate = np.sqrt(np.maximum(stiffness, 0.0) / np.maximum(model.dof_M0, np.finfo(float).tiny))
    order = [dof for dof in np.argsort(-rate).tolist() if rate[dof] * model.opt.timestep > 1.0]
    return [
        f"{_joint(model, int(model.dof_jntid[dof]))} swings at {rate[dof] / 2.0 / np.pi:.3g} Hz,"
        f" with stiffness {stiffness[dof]:.3g} and inertia {model.dof_M0[dof]:.3g}: the timestep of"
        f" {model.opt.timestep:g} s is too long for it; at most {1.0 / rate[dof]:.2g} s, or less"
        " stiffness, or armature"
        for dof in order[:_MOST]
    ]


def bare_dofs(model: mujoco.MjModel) -> IntArray:
    """Degrees of freedom of hinges and slides that have neither damping nor armature, (n,)."""
    single = np.isin(model.jnt_type[model.dof_jntid], [_HINGE, _SLIDE])
    return np.flatnonzero(single & (model.dof_damping == 0.0) & (model.dof_armature == 0.0))


def _joint(model: mujoco.MjModel, joint: int) -> str:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    body = _body(model, int(model.jnt_bodyid[joint]))
    return f"joint {name!r} of {body}" if name else f"a joint of {body}"


def _body(model: mujoco.MjModel, body: int) -> str:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
    return f"body {name!r}" if name else f"body {body}"
