"""A batch of simulations as named live arrays: a task's only access to the simulator.

    sim.qpos          (B, nq), sim.sensordata, sim.xpos ... with MjData's names, of the active rollouts
    sim.own["goal"]   (B, ...), the task's own memory for each of them
    sim.t             control steps done
    sim.expand("geom_friction")   a field of the model with separate values for each rollout

While a rollout is prepared the arrays are writable views; afterwards they are read-only.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import TaskError

LIMIT = 1e8
"""States beyond this count as unstable, finite or not."""


class Rebound(Exception):  # noqa: N818  not an error
    """An output of the simulator was requested for the first time: the batch is restarted, now with its values."""


@runtime_checkable
class Engine(Protocol):
    """Simulates rows of states of one model. Made by a backend, or by the task itself."""

    model: mujoco.MjModel
    size: int
    """Rows."""

    def field(self, name: str) -> AnyArray:
        """A live array over all rows, (size, ...), by its name in MjData; outputs are read-only.

        Raises Rebound if its values exist only after the next call, AttributeError if there is no such array.
        """

    def reset(self, ids: IntArray) -> None:
        """Reset rows to the model's initial state."""

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance rows by one physics step for each of their controls, (n, steps, nu)."""

    def forward(self, ids: IntArray) -> None:
        """Compute the outputs of rows from their states."""

    def copy(self, sources: IntArray) -> None:
        """Give row i the state of row sources[i]; rows are never copied downwards onto later sources."""

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Rows whose state is no longer a reasonable number, (n,)."""

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """MuJoCo's cfrc_ext of rows after their last step, (n, nbody, 6); may raise Rebound like `field`."""

    def expand(self, name: str) -> AnyArray:
        """A field of the model with values for each row, live, (size, ...)."""

    def set_const(self, ids: IntArray) -> None:
        """Update derived constants after writes to expanded fields."""

    def close(self) -> None:
        """Release its resources."""


class Backend(Protocol):
    """Makes a worker's engines for models; constructed without arguments."""

    capacity: ClassVar[int]
    """Number of rollouts that are worth simulating at a time."""
    exact: ClassVar[bool]
    """Whether its numbers are those of the backend `cpu` to the last bit; true where a class does not say."""

    def engine(self, model: mujoco.MjModel) -> Engine:
        """Make an engine for this many simulations of a model."""


_ATTRIBUTES = ("engine", "own", "t")

MakeEngine = Callable[[mujoco.MjModel], Engine]


class Sim:
    """A batch of rollouts in an engine."""

    def __init__(self, engine: Engine) -> None:
        """Use an engine; call `begin` next. A TaskError if it is none."""
        if not isinstance(engine, Engine):
            names = [*Engine.__annotations__, *(name for name in vars(Engine) if not name.startswith("_"))]
            missing = ", ".join(name for name in names if not hasattr(engine, name))
            raise TaskError(f"the backend gave a {type(engine).__name__}, which is no engine: it has no {missing}")
        self.engine = engine
        self.own: dict[str, AnyArray] = {}
        """The task's memory for each rollout, (B, ...); rows stay with their rollouts when other rollouts end."""
        self.t = 0
        """Control steps done."""
        self._ids: IntArray = np.arange(0)
        self._source: IntArray | None = None  # rows that outputs are read from, until the first step
        self._expanded: dict[str, AnyArray] = {}
        self._nominal: dict[str, AnyArray] = {}  # the model's own values of them
        self._dirty = self._live = self._stepped = False
        self._now: dict[str, AnyArray] = {}

    @property
    def model(self) -> mujoco.MjModel:
        """What is simulated; never changed."""
        return self.engine.model

    def __len__(self) -> int:
        """B, the rollouts still going."""
        return len(self._ids)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  an array of MjData
        if name.startswith("_"):
            raise AttributeError(name)
        known = self._now.get(name)
        if known is not None:
            return known
        values = self.engine.field(name)
        if self._live:
            if not values.flags.writeable and not self._stepped:  # states may have been written
                self._constants()
                self.engine.forward(self._ids)
            return values[: len(self)]
        self._now[name] = taken = self._rows(values)
        return taken

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _ATTRIBUTES and not name.startswith("_"):
            raise AttributeError(f"sim.{name} is written in place: sim.{name}[:] = ...; keep your values in sim.own")
        super().__setattr__(name, value)

    def _rows(self, values: AnyArray) -> AnyArray:
        """The rows still going, read-only."""
        rows = self._ids if self._source is None or values.flags.writeable else self._source
        whole = rows[-1] == len(rows) - 1 and self._source is None if len(rows) else False
        taken = values[: len(rows)] if whole else values[rows]  # rows rise: the last one tells whether some are gone
        taken = taken.view()
        taken.flags.writeable = False
        return taken

    def begin(self, count: int) -> None:
        """Begin `count` rollouts at the model's own start; arrays can be written until `start`."""
        self._ids, self._source = np.arange(count), None
        self.own, self.t, self._now = {}, 0, {}
        self._live, self._stepped = True, False
        for name, values in self._expanded.items():  # before the reset: what it takes from the model is nominal too
            values[:count] = self._nominal[name]
        self.engine.reset(self._ids)
        self._dirty = bool(self._expanded)

    def start(self, sources: IntArray) -> None:
        """End the preparation: B rollouts; rollout i starts in the state of the prepared one sources[i].

        Raises:
          TaskError: an entry of `own` is not an array with one row per rollout.
        """
        for name, values in self.own.items():
            if not isinstance(values, np.ndarray) or np.shape(values)[:1] != (len(self),):
                got = f"shape {values.shape}" if isinstance(values, np.ndarray) else f"a {type(values).__name__}"
                raise TaskError(f"sim.own[{name!r}] is {got}; expected an array of shape ({len(self)}, ...)")
        self._dirty = bool(self._expanded)  # states may have been written since outputs were read
        shared = len(sources) != len(self._ids) or (sources != self._ids).any()
        if not (shared and self._stepped):
            self._constants()
        if not self._stepped:
            self.engine.forward(self._ids)
        self._live = False
        if not shared:
            return
        self._ids = np.arange(len(sources))
        self.engine.copy(sources)
        for values in self._expanded.values():
            values[: len(sources)] = values[sources]
        if self._expanded:
            self.engine.set_const(self._ids)
            self._dirty = False
        self.own = {name: values[sources] for name, values in self.own.items()}
        self._source = sources

    def expand(self, name: str) -> AnyArray:
        """A field of MjModel with a value for each rollout, (B, ...); read-only once they are prepared."""
        if name not in self._expanded:
            self._nominal[name] = np.array(own_value(self.model, name))
            self._expanded[name] = self.engine.expand(name)
        if not self._live:
            values = self._expanded[name][self._ids]
            values.flags.writeable = False
            return values
        self._dirty = True
        return self._expanded[name][: len(self)]

    def step(self, count: int = 1) -> None:
        """Advance all rollouts by physics steps."""
        self._constants()
        self._moved()
        self.engine.step(self._ids, count)

    def play(self, controls: FloatArray) -> None:
        """Advance all rollouts by one physics step for each of the controls, (steps, nu)."""
        self._constants()
        self._moved()
        self.engine.play(self._ids, np.broadcast_to(controls, (len(self), *controls.shape)))

    def contact_forces(self) -> FloatArray:
        """Contact forces on every body after the last physics step (MuJoCo's cfrc_ext), (B, nbody, 6)."""
        known = self._now.get("contact_forces")
        if known is None:
            known = self._now["contact_forces"] = self.engine.contact_forces(self._ids)
        return known

    def forward(self) -> None:
        """Compute outputs from the states as they were written."""
        self._constants()
        self._moved()
        self.engine.forward(self._ids)

    def control(self, values: FloatArray) -> None:
        """Set the controls, (B, nu)."""
        self.engine.field("ctrl")[self._ids] = values
        self._now.pop("ctrl", None)

    def blown_up(self) -> BoolArray:
        """Which rollouts' states are no longer reasonable numbers, (B,)."""
        return self.engine.blown_up(self._ids)

    def keep(self, going: BoolArray) -> None:
        """Remove the finished rollouts, (B,)."""
        self._ids, self._now = self._ids[going], {}
        self.own = {name: values[going] for name, values in self.own.items()}

    def _moved(self) -> None:
        self._now, self._source, self._stepped = {}, None, True

    def _constants(self) -> None:
        """Update derived constants if what they depend on may have been written."""
        if self._dirty:
            self.engine.set_const(self._ids)
            self._dirty = False


def own_value(model: mujoco.MjModel, name: str) -> Any:  # noqa: ANN401  a number or an array
    """A field of the model, or (opt.NAME) of its options."""
    return getattr(model.opt, name.removeprefix("opt.")) if name.startswith("opt.") else getattr(model, name)


def failed_rows(state: FloatArray) -> BoolArray:
    """Rows (n, nstate) with a number that is not reasonable, (n,)."""
    return np.asarray(~(np.abs(state) < LIMIT).all(axis=1))
