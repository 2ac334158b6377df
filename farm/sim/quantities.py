"""What the numbers of a model's states and controls are: names, units and ranges, in the model's
order.
"""

import math
from collections.abc import Iterator
from typing import Any, Final

import mujoco

from farm.sim.channels import Quantity

# As whole numbers: MuJoCo's names are not equal to the elements of its arrays.
_HINGE, _SLIDE, _FREE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("HINGE", "SLIDE", "FREE")
)
_QUATERNION: Final = tuple(f"quaternion {axis}" for axis in "wxyz")
_OF_JOINT: Final = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_LAGGING: Final = tuple(
    int(getattr(mujoco.mjtDyn, f"mjDYN_{name}")) for name in ("NONE", "FILTER", "FILTEREXACT")
)


def joints(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """Every joint: its name, kind, unit, range (None where it has none), and where qpos and qvel
    have it first.
    """
    out = []
    for i in range(model.njnt):
        low, high = model.jnt_range[i].tolist() if model.jnt_limited[i] else (None, None)
        kind = int(model.jnt_type[i])
        out.append(
            {
                "name": _joint(model, i),
                "kind": mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower(),
                "unit": _lengths(kind)[0],
                "low": low,
                "high": high,
                "qpos": int(model.jnt_qposadr[i]),
                "qvel": int(model.jnt_dofadr[i]),
            }
        )
    return out


def states(model: mujoco.MjModel) -> tuple[Quantity, ...]:
    """The numbers of qpos, then those of qvel."""
    return (*_positions(model), *_velocities(model))


def _positions(model: mujoco.MjModel) -> Iterator[Quantity]:
    for i in range(model.njnt):
        name, kind = _joint(model, i), model.jnt_type[i]
        if kind in (_HINGE, _SLIDE):
            bounds = model.jnt_range[i].tolist() if model.jnt_limited[i] else ()
            yield Quantity(name, _lengths(kind)[0], *bounds)
            continue
        if kind == _FREE:
            yield from (Quantity(f"{name} {axis}", "m") for axis in "xyz")
        yield from (Quantity(f"{name} {part}", "", -1.0, 1.0) for part in _QUATERNION)


def _velocities(model: mujoco.MjModel) -> Iterator[Quantity]:
    for i in range(model.njnt):
        name, kind = f"{_joint(model, i)} velocity", model.jnt_type[i]
        if kind in (_HINGE, _SLIDE):
            yield Quantity(name, f"{_lengths(kind)[0]}/s")
            continue
        if kind == _FREE:
            yield from (Quantity(f"{name} {axis}", "m/s") for axis in "xyz")
        yield from (Quantity(f"{name} about {axis}", "rad/s") for axis in "xyz")


def controls(model: mujoco.MjModel) -> tuple[Quantity, ...]:
    """The numbers of ctrl: actuators by name, those without one by what they move, and what a
    control of 1 is.
    """
    return tuple(
        Quantity(
            model.actuator(i).name or moved(model, i) or f"actuator {i}",
            _unit(model, i),
            *(model.actuator_ctrlrange[i].tolist() if model.actuator_ctrllimited[i] else ()),
        )
        for i in range(model.nu)
    )


def of_joint(model: mujoco.MjModel, actuator: int) -> int | None:
    """The hinge or slide that an actuator moves; None if it moves something else."""
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] not in _OF_JOINT or model.jnt_type[target] not in (
        _HINGE,
        _SLIDE,
    ):
        return None
    return target


def is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's control is a position of what it moves, times its gear."""
    gain, (_, stiffness, *_) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    return bool(
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[actuator] in _LAGGING
        and gain > 0.0
        and stiffness == -gain
    )


def moved(model: mujoco.MjModel, actuator: int) -> str:
    """Name of the joint or tendon that an actuator moves; empty if it moves something else."""
    kind, target = model.actuator_trntype[actuator], int(model.actuator_trnid[actuator, 0])
    if kind in _OF_JOINT:
        return _joint(model, target)
    return str(model.tendon(target).name) if kind == mujoco.mjtTrn.mjTRN_TENDON else ""


def _joint(model: mujoco.MjModel, i: int) -> str:
    return model.joint(i).name or f"joint {i}"


def _lengths(kind: int) -> tuple[str, str]:
    """Units of a joint's position, and of a force along it; empty if it has several."""
    return {_HINGE: ("rad", "N m"), _SLIDE: ("m", "N")}.get(int(kind), ("", ""))


def _unit(model: mujoco.MjModel, i: int) -> str:
    """Unit of a control: a position, velocity or force, perhaps several times its unit;
    empty if unknown.
    """
    length, force = _moves_in(model, i)
    gear, (gain, *_) = float(model.actuator_gear[i, 0]), model.actuator_gainprm[i].tolist()
    _, stiffness, damping, *_ = model.actuator_biasprm[i].tolist()
    lagging = model.actuator_dyntype[i] in _LAGGING
    if (
        not length
        or not gear
        or gain <= 0.0
        or model.actuator_gaintype[i] != mujoco.mjtGain.mjGAIN_FIXED
    ):
        return ""
    if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE:
        return _times(gain * gear, force) if lagging else ""
    if stiffness == -gain:  # a servo; one that integrates its control is told a velocity
        integrates = model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        return (
            _times(1.0 / gear, f"{length}/s" if integrates else length)
            if lagging or integrates
            else ""
        )
    return (
        _times(1.0 / gear, f"{length}/s") if lagging and not stiffness and damping == -gain else ""
    )


def _moves_in(model: mujoco.MjModel, i: int) -> tuple[str, str]:
    """Units of the length that an actuator changes, and of its force; empty if unknown."""
    kind, target = model.actuator_trntype[i], int(model.actuator_trnid[i, 0])
    if kind in _OF_JOINT:
        return _lengths(model.jnt_type[target])
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return "", ""
    # A tendon of joints adds up lengths of several kinds
    first = model.wrap_type[model.tendon_adr[target]]
    return ("", "") if first == mujoco.mjtWrap.mjWRAP_JOINT else ("m", "N")


def _times(factor: float, unit: str) -> str:
    return unit if math.isclose(factor, 1.0) else f"{factor:g} {unit}"
