"""MuJoCo on the CPU: many simulations in mujoco.batch, or one in an MjData."""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco
import mujoco.batch
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.sim import complaints
from farm.sim.interfaces import Rebound
from farm.sim.sim import as_rows, failed_rows, own_value

CAPACITY = 64
"""Number of rollouts that are stepped together."""

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Everything that the next step depends on, as mujoco.batch keeps it."""


class BatchEngine:
    """Simulations in mujoco.batch, with the same numbers as a plain `mj_step` loop; of one
    model, or of several whose data have one layout (`takes`, `assign`).
    """

    def __init__(self, model: mujoco.MjModel, size: int = CAPACITY, threads: int = 1) -> None:
        """Make room for `size` rows; the physics runs on `threads`."""
        _keep_unstable(model)
        self.model, self.size, self._threads = model, size, threads
        self._batch = mujoco.batch.Batch(model, size, threads)
        self._fields: dict[str, AnyArray] = {}
        self._data: mujoco.MjData | None = None
        self._rows = _Rows(model, size)
        self._complaint = ""

    def takes(self, model: mujoco.MjModel) -> bool:
        """Whether rows can be of this model as well, as its data have the same layout; `assign`
        then says which are.
        """
        try:
            self._batch.set_models(model)
            self._batch.set_models(None)
        except mujoco.FatalError:
            return False
        _keep_unstable(model)
        self._rows.models.append(model)
        return True

    def assign(self, which: IntArray) -> None:
        """Say which of its models each of the first rows has, (n,)."""
        self._batch.set_models(self._rows.assigned(which))

    def field(self, name: str) -> AnyArray:
        """A live array over all rows."""
        values = self._fields.get(name)
        if values is None:
            check_field(name)
            values = self._fields[name] = self._batch.bind(name)
            if not values.flags.writeable:
                raise Rebound
        return values

    def reset(self, ids: IntArray) -> None:
        """Bring rows to the model's own start."""
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""
        with self._surviving():
            self._batch.step(ids, nstep=count)

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance rows by one physics step for each of their controls."""
        with self._surviving():
            self._batch.rollout(
                controls.shape[1], controls, int(mujoco.mjtState.mjSTATE_CTRL), record=(), ids=ids
            )

    def forward(self, ids: IntArray) -> None:
        """Compute outputs."""
        with self._surviving():
            self._batch.forward(ids)

    @contextmanager
    def _surviving(self) -> Iterator[None]:
        """Advance rows.

        Those in which MuJoCo itself raised an error count as unstable, the others continue.
        """
        try:
            yield
        except mujoco.batch.SimulationError as error:
            self._complaint = " ".join(self._batch.error(int(error.ids[0])).split())
            self._batch.state[error.ids] = np.nan

    def copy(self, sources: IntArray) -> None:
        """Give row i the state of row sources[i]."""
        self._batch.state[: len(sources)] = self._batch.state[sources]

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Rows whose state is no longer a reasonable number."""
        return failed_rows(self._batch.state[as_rows(ids)])

    def complaint(self) -> str:
        """MuJoCo's words about the last error that ended a row, once; empty without one."""
        words, self._complaint = self._complaint, ""
        return words

    def warned(self, ids: IntArray) -> IntArray:
        """Number of MuJoCo's warnings of each of `complaints.KINDS` in rows, (n, K): it never
        counts down.
        """
        return complaints.chosen(self._batch.warning[ids, :, 1])

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """Forces of contacts on every body of rows, (n, nbody, 6)."""
        if self._data is None:  # each row needs its own MjData, in the state after its last step
            self._data = mujoco.MjData(self.model)
            self._batch = mujoco.batch.Batch(self.model, self.size, self._threads, persistent=True)
            self._fields.clear()
            raise Rebound
        out = np.empty((len(ids), self.model.nbody, 6))
        for row, sim in enumerate(ids.tolist()):
            self._batch.get_data(sim, self._data)
            mujoco.mj_rnePostConstraint(self._rows.own[sim], self._data)
            out[row] = self._data.cfrc_ext
        return out

    def ray(
        self, ids: IntArray, points: FloatArray, ways: FloatArray, without: int
    ) -> tuple[FloatArray, IntArray]:
        """Distances and geometries that rays (n, R, 3) hit, (n, R) each."""
        dist, geom = self._batch.ray(points, ways, bodyexclude=without, ids=ids)
        return dist, geom.astype(int)

    def jac(self, ids: IntArray, body: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobians of points (n, 3) of a body, (n, 3, nv) each."""
        return self._batch.jac(body, points, ids)

    def expand(self, name: str) -> AnyArray:
        """A field of the model with values for each row."""
        return self._batch.expand(name) if len(self._rows.models) == 1 else self._rows.expand(name)

    def set_const(self, ids: IntArray) -> None:
        """Update derived constants."""
        if len(self._rows.models) == 1:
            self._batch.set_const(ids)
        else:
            self._batch.set_models(self._rows.changed(ids))

    def close(self) -> None:
        """Release nothing: Python frees what the engine holds."""


class _Rows:
    """Which model each row of a batch has: mujoco.batch expands no fields of several models, so
    each row whose fields are its own has a copy of its model.
    """

    def __init__(self, model: mujoco.MjModel, size: int) -> None:
        self.models = [model]
        self.own = [model] * size
        """The model of each row."""
        self._which, self._nth = (np.zeros(size, dtype=int) for _ in range(2))
        self._values: dict[str, AnyArray] = {}
        # Copies of a model, for the nth row that has it
        self._copies: dict[tuple[int, int], mujoco.MjModel] = {}

    def assigned(self, which: IntArray) -> list[mujoco.MjModel]:
        """Models of all rows if those of the first rows are `which`, (n,)."""
        self._which[: len(which)] = which
        for model in range(len(self.models)):
            rows = np.flatnonzero(self._which == model)
            self._nth[rows] = np.arange(len(rows))
        self.own = [self.models[model] for model in self._which.tolist()]
        return self.own

    def expand(self, name: str) -> AnyArray:
        """A field with values for each row, (size, ...)."""
        if name not in self._values:
            self._values[name] = np.stack(
                [np.asarray(own_value(model, name)) for model in self.own]
            )
        return self._values[name]

    def changed(self, ids: IntArray) -> list[mujoco.MjModel]:
        """Models of all rows, after rows got their own values and what follows from them."""
        data = mujoco.MjData(self.models[0])
        for row in ids.tolist():
            model, nth = int(self._which[row]), int(self._nth[row])
            if (model, nth) not in self._copies:
                self._copies[model, nth] = copy.copy(self.models[model])
            variant = self.own[row] = self._copies[model, nth]
            for name, values in self._values.items():
                if values.ndim == 1:  # a number of the options
                    setattr(variant.opt, name.removeprefix("opt."), values[row])
                else:
                    own_value(variant, name)[:] = values[row]
            mujoco.mj_resetData(variant, data)
            mujoco.mj_setConst(variant, data)
        return self.own


class DataEngine:
    """One simulation in an MjData, for viewers."""

    size = 1

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.pace: Callable[[], bool] | None = None
        """Advances it by a physics step, and returns whether to continue; by default `mj_step`."""
        self.over = False
        """Whether `pace` asked to stop."""

    def field(self, name: str) -> AnyArray:
        """A live array of one row."""
        check_field(name)
        values = np.asarray(getattr(self.data, name))[None]
        if name not in STATE_FIELDS:
            values.flags.writeable = False
        return values

    def reset(self, ids: IntArray) -> None:  # noqa: ARG002
        """Bring it to the model's own start."""
        mujoco.mj_resetData(self.model, self.data)

    def step(self, ids: IntArray, count: int) -> None:  # noqa: ARG002
        """Advance it by physics steps."""
        for _ in range(count):
            if self.pace is None:
                mujoco.mj_step(self.model, self.data)
            elif not self.pace():
                self.over = True
                return

    def play(self, ids: IntArray, controls: FloatArray) -> None:  # noqa: ARG002
        """Advance it by one physics step per control, without showing it."""
        for control in controls[0]:
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data)

    def forward(self, ids: IntArray) -> None:  # noqa: ARG002
        """Compute outputs."""
        mujoco.mj_forward(self.model, self.data)

    def copy(self, sources: IntArray) -> None:
        """Do nothing: there is only one row."""

    def blown_up(self, ids: IntArray) -> BoolArray:  # noqa: ARG002
        """Whether the simulation's state is no longer a reasonable number."""
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        return failed_rows(state[None])

    def contact_forces(self, ids: IntArray) -> FloatArray:  # noqa: ARG002
        """Forces of contacts on every body, (1, nbody, 6)."""
        mujoco.mj_rnePostConstraint(self.model, self.data)
        return self.data.cfrc_ext[None].copy()

    def ray(
        self,
        ids: IntArray,  # noqa: ARG002
        points: FloatArray,
        ways: FloatArray,
        without: int,
    ) -> tuple[FloatArray, IntArray]:
        """Distances and geometries that rays (1, R, 3) hit, (1, R) each."""
        data, geom = self._present(), np.zeros((1, 1), dtype=np.int32)
        hits = []
        for point, way in zip(points[0], ways[0], strict=True):
            dist = mujoco.mj_ray(self.model, data, point, way, None, 1, without, geom[0])
            hits.append((dist, int(geom[0, 0])))
        return np.array([[dist for dist, _ in hits]]), np.array([[which for _, which in hits]])

    def jac(self, ids: IntArray, body: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002
        """Jacobians of a point (1, 3) of a body, (1, 3, nv) each."""
        moves, turns = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, self._present(), moves, turns, points[0], body)
        return moves[None], turns[None]

    def _present(self) -> mujoco.MjData:
        """Where everything is now, beside the data, whose outputs stay."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.data.qpos
        data.mocap_pos[:] = self.data.mocap_pos
        data.mocap_quat[:] = self.data.mocap_quat
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        return data

    def expand(self, name: str) -> AnyArray:
        """A field of the model, as one row."""
        return np.asarray(own_value(self.model, name))[None]

    def set_const(self, ids: IntArray) -> None:  # noqa: ARG002
        """Update derived constants."""
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def close(self) -> None:
        """Release nothing: Python frees what the engine holds."""


def _keep_unstable(model: mujoco.MjModel) -> None:
    """Let unstable states stay unstable."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def check_field(name: str) -> None:
    """Raise an AttributeError unless MjData has such a field."""
    if name not in mujoco.batch.DATA_FIELDS:
        raise AttributeError(
            f"sim has no {name!r}: it has the fields of MuJoCo's MjData, own and t"
        )


STATE_FIELDS = (
    *(
        "time",
        "qpos",
        "qvel",
        "act",
        "history",
        "qacc_warmstart",
        "plugin_state",
        "ctrl",
        "qfrc_applied",
    ),
    *("xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata"),
)
"""Fields of MjData that can be written; all others are outputs."""
