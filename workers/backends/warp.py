"""The backend `warp`: MuJoCo Warp, thousands of simulations that step together on an NVIDIA GPU.

Only this module imports it. The device computes in single precision, so results differ from those
of the backend `cpu`. On a GPU they also depend on the batch, since its option `deterministic` makes
it 8 to 20 times slower. Tasks read arrays in the host's memory, which are updated after each
control step, not each physics step.
"""

import copy
from typing import Any, ClassVar, Final

import mujoco
import mujoco_warp
import numpy as np
import warp

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import FarmError
from farm.sim.engines import STATE_FIELDS, check_field
from farm.sim.interfaces import Rebound
from farm.sim.sim import failed_rows, own_value

_Overflow: Final = mujoco_warp.OverflowType
_FULL: Final = int(_Overflow.ALL & ~(_Overflow.ITERATIONS | _Overflow.LS_ITERATIONS))
"""Overflows of contacts or constraints; a solver that reaches its last iteration is not an
overflow.
"""
_MEANINGLESS: Final = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET) | int(
    mujoco.mjtDisableBit.mjDSBL_MIDPHASE
)
"""Flags that Warp refuses and that change nothing there: it never resets by itself and has no
midphase.
"""
_ROOM: Final = 2
"""Buffers for contacts and constraints with which a model begins, as a factor of MuJoCo Warp's own
sizes.

These are a guess from the model (64 constraints for the hand; one in a hundred rollouts has more),
and kernels are compiled anew for each size.
"""
_MOST_ROOM: Final = 64
_DERIVED: Final = (
    *(
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "tendon_length0",
        "tendon_invweight0",
        "actuator_acc0",
    ),
    *("geom_aabb", "geom_rbound", "eq_data"),
)
"""Constants that MuJoCo derives from other fields, which may differ between rollouts."""


class WarpBackend:
    """Makes engines of MuJoCo Warp, on the GPU if there is one.

    Its workers take part only in runs with `--any-rounding`. The GPU simulates exploring rollouts;
    MuJoCo on the worker's processor simulates the mean policy and everything that is recorded.
    """

    capacity: ClassVar[int] = 4096
    exact: ClassVar[bool] = False

    def engine(self, model: mujoco.MjModel) -> "WarpEngine":
        """An engine for this model's simulations."""
        return WarpEngine(model, self.capacity)


class WarpEngine:
    """Simulations of one model in MuJoCo Warp, each in a world of its own."""

    def __init__(self, model: mujoco.MjModel, size: int) -> None:
        """Permit `size` rows; the device's memory is allocated when rows are used.

        Raises:
          FarmError: MuJoCo Warp does not support this model.
        """
        warp.config.log_level = warp.LOG_WARNING
        self.model, self.size = model, size
        self._plain = copy.copy(model)
        self._plain.opt.disableflags &= ~_MEANINGLESS
        self._host: dict[str, AnyArray] = {}  # (size, ...)
        self._expanded: dict[str, AnyArray] = {}  # (size, ...)
        self._example = mujoco.MjData(model)
        self._worlds, self._room, self._graph = 0, _ROOM, None
        self._device: Any = None
        self._data: Any = None
        self._put(1)

    def field(self, name: str) -> AnyArray:
        """A live array over all rows."""
        values = self._host.get(name)
        if values is None:
            check_field(name)
            if not hasattr(self._data, name):
                raise AttributeError(
                    f"sim has no {name!r} on the backend warp: MuJoCo Warp does not give it"
                )
            like = np.asarray(getattr(self._example, name))
            values = self._host[name] = np.zeros((self.size, *like.shape), like.dtype)
            self._read(name)
        values = values.view()
        values.flags.writeable = name in STATE_FIELDS
        return values

    def reset(self, ids: IntArray) -> None:
        """Set all rows to the model's initial state."""
        self._put(len(ids))
        mujoco_warp.reset_data(self._device, self._data)
        self._read_all()

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""
        self._write()
        for _ in range(count):
            self._advance()
        self._checked(ids)

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance rows by one physics step per control."""
        self._write()
        row = np.zeros((self._worlds, self.model.nu), dtype=np.float32)
        for step in range(controls.shape[1]):
            row[ids] = controls[:, step]
            self._data.ctrl.assign(row)
            self._advance()
        self._checked(ids)

    def forward(self, ids: IntArray) -> None:
        """Compute outputs."""
        self._write()
        mujoco_warp.forward(self._device, self._data)
        self._checked(ids)

    def copy(self, sources: IntArray) -> None:
        """Give row i the state of row sources[i]."""
        self._write()
        state = {
            name: _numbers(getattr(self._data, name))[sources]
            for name in STATE_FIELDS
            if self._has(name)
        }
        self._put(len(sources))
        for name, values in state.items():
            whole = _numbers(getattr(self._data, name))
            whole[: len(sources)] = values
            getattr(self._data, name).assign(whole)
            if name in self._host:
                self._read(name)

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Rows whose state is no longer a reasonable number."""
        return failed_rows(
            np.concatenate([self.field(name)[ids] for name in ("qpos", "qvel", "act")], axis=1)
        )

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """Forces of contacts on every body of rows, (n, nbody, 6)."""
        mujoco_warp.rne_postconstraint(self._device, self._data)
        return _numbers(self._data.cfrc_ext)[ids].astype(float)

    def expand(self, name: str) -> AnyArray:
        """A field of the model with values for each row."""
        if name not in self._expanded:
            value = np.asarray(own_value(self.model, name))
            self._expanded[name] = np.tile(value, (self.size, *[1] * value.ndim))
            self._model()
        return self._expanded[name]

    def set_const(self, ids: IntArray) -> None:  # noqa: ARG002  those of all rows are updated
        """Update derived constants."""
        for name, values in self._expanded.items():
            field = getattr(self._device, name)
            field.assign(_like(values[: self._worlds], field))
        mujoco_warp.set_const(self._device, self._data)

    def close(self) -> None:
        """Free the device's memory."""
        self._device = self._data = self._graph = None

    def _put(self, rows: int) -> None:
        """Allocate at least this number of worlds; if it grows, all states are lost."""
        if rows <= self._worlds:
            return
        self._worlds = min(self.size, 1 << (rows - 1).bit_length())
        self._model()
        contacts, constraints = (int(n) for n in _defaults(self._plain))
        self._data = mujoco_warp.make_data(
            self._plain,
            nworld=self._worlds,
            nconmax=self._room * contacts,
            njmax=self._room * constraints,
        )

    def _model(self) -> None:
        fields = {*self._expanded, *(_DERIVED if self._expanded else ())}
        sizes = {name: self._worlds for name in fields if np.size(own_value(self.model, name))}
        try:
            self._device = mujoco_warp.put_model(self._plain, batch_sizes=sizes)
        except (NotImplementedError, ValueError) as error:
            raise FarmError(f"MuJoCo Warp cannot simulate this model: {error}") from None
        self._device.opt.warn_overflow = False
        self._device.opt.contact_sensor_maxmatch *= self._room
        self._graph = None

    def _advance(self) -> None:
        """One physics step; on a GPU its hundreds of kernels are recorded once and launched
        together.
        """
        if not warp.get_device().is_cuda:
            mujoco_warp.step(self._device, self._data)
            return
        if self._graph is None:
            mujoco_warp.step(self._device, self._data)  # compiles
            with warp.ScopedCapture() as capture:
                mujoco_warp.step(self._device, self._data)
            self._graph = capture.graph
            return
        warp.capture_launch(self._graph)

    def _checked(self, ids: IntArray) -> None:
        """Read the requested arrays back, unless the buffers for contacts or constraints
        overflowed.

        Raises:
          Rebound: they did; the batch must start again with buffers of twice the size, as no
              contact may be dropped.
          FarmError: they overflowed at the largest permitted size.
        """
        full = int(np.bitwise_or.reduce(_numbers(self._data.overflow)[ids], initial=0)) & _FULL
        if not full:
            self._read_all()
            return
        self._room, self._worlds = 2 * self._room, 0
        if self._room > _MOST_ROOM:
            raise FarmError(
                f"MuJoCo Warp has no room for this model's contacts: {_Overflow(full).name}"
            )
        raise Rebound

    def _has(self, name: str) -> bool:
        return hasattr(self._data, name) and np.size(getattr(self._example, name)) > 0

    def _write(self) -> None:
        """Copy the host's states to the device; rounding an unchanged state to single precision
        changes nothing.
        """
        for name, values in self._host.items():
            if name in STATE_FIELDS and self._has(name):
                field = getattr(self._data, name)
                field.assign(_like(values[: self._worlds], field))

    def _read_all(self) -> None:
        for name in self._host:
            self._read(name)

    def _read(self, name: str) -> None:
        if self._has(name):
            values = self._host[name]
            values[: self._worlds] = _numbers(getattr(self._data, name)).reshape(
                self._worlds, *values.shape[1:]
            )


def _numbers(values: Any) -> AnyArray:  # noqa: ANN401  a warp array
    """A copy on the host, (worlds, ...)."""
    return np.array(values.numpy())


def _like(values: AnyArray, field: Any) -> AnyArray:  # noqa: ANN401  a warp array
    """Values of the host in the device's type and shape."""
    array = field.numpy()
    return np.ascontiguousarray(values.reshape(array.shape), dtype=array.dtype)


def _defaults(model: mujoco.MjModel) -> tuple[int, int]:
    """Numbers of contacts and constraints that MuJoCo Warp allocates per world by default."""
    data = mujoco_warp.make_data(model)
    return data.naconmax, data.njmax
