"""A batch of simulations as named live arrays: a task's only access to the simulator.

    sim.qpos          (B, nq), sim.sensordata, sim.xpos ... of the active rollouts, as in MjData
    sim.joint("hinge").qpos       (B, 1), of one object, with MuJoCo's names
    sim.own["goal"]   (B, ...), the task's own memory for each of them
    sim.t             control steps done
    sim.which         (B,), which of the task's models each rollout has
    sim.expand("geom_friction")   a field of the model with separate values for each rollout
    sim.noise(3)      (B, 3), random numbers of each rollout's own in this control step

While a rollout is prepared the arrays are writable views. Afterwards they are read-only, but for
those of WRITABLE in `act`: what it writes there counts from the next physics step on.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import TaskError
from farm.noise import KINDS as KINDS_OF_NOISE
from farm.noise import Kind, key, numbers
from farm.sim.complaints import KINDS
from farm.sim.interfaces import Engine
from farm.sim.named import Named

LIMIT = 1e8
"""States beyond this count as unstable, finite or not."""

WRITABLE: Final = (
    *(
        "qpos",
        "qvel",
        "act",
        "eq_active",
        "mocap_pos",
        "mocap_quat",
        "qfrc_applied",
        "xfrc_applied",
    ),
)
"""Fields of MjData that a task's `act` may write, unless the engine's `writable` says otherwise."""

_CAN: Final = f"act can write sim.own and, of sim, {', '.join(WRITABLE)}"


_ATTRIBUTES = ("engine", "own", "t", "which")


class Sim:
    """A batch of rollouts in an engine.

    A task gets it with each call. Arrays have MjData's names and units. A write to the attribute
    itself (`sim.qpos = ...`), and not into its rows, is an AttributeError.

    Example:
      ```python
      import mujoco
      import numpy as np

      import farm
      from farm.sim.engines import BatchEngine

      ball = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
      sim = farm.Sim(BatchEngine(mujoco.MjModel.from_xml_string(ball), 3))
      sim.begin(3)
      sim.qpos[:, 2] = [1.0, 2.0, 3.0]  # heights [m]; (B, nq)
      sim.start(np.arange(3))
      sim.step(100)
      assert (sim.qvel[:, 2] < -1.9).all()  # they fall for 0.2 s
      ```
    """

    def __init__(self, engine: Engine) -> None:
        """Use an engine; call `begin` next. A TaskError if it is none."""
        if not isinstance(engine, Engine):
            names = [
                *Engine.__annotations__,
                *(name for name in vars(Engine) if not name.startswith("_")),
            ]
            missing = ", ".join(name for name in names if not hasattr(engine, name))
            raise TaskError(
                f"the backend gave a {type(engine).__name__}, which is no engine: it has no"
                f" {missing}"
            )
        self.engine = engine
        self.own: dict[str, AnyArray] = {}
        """The task's memory for each rollout, (B, ...); rows stay with their rollouts when other
        rollouts end.
        """
        self.t = 0
        """Control steps done."""
        self.which: IntArray = np.arange(0)
        """Which of `models` each rollout has, (B,)."""
        self._ids: IntArray = np.arange(0)
        self._rows: slice | IntArray = slice(0)  # the same, for arrays
        self._seeds: Sequence[Sequence[int] | None] = ()  # of the prepared rollouts
        self._prepared: IntArray = np.arange(0)  # which of them each rollout started from
        self._keys: AnyArray | None = None  # of the prepared ones, once they are needed
        self._still: BoolArray = np.zeros(0, dtype=bool)  # which of those are nominal
        # Rows that outputs are read from, until the first step
        self._source: IntArray | None = None
        self._expanded: dict[str, AnyArray] = {}
        self._nominal: dict[str, AnyArray] = {}  # the models' own values of them, (M, ...)
        self._dirty = self._live = self._stepped = False
        self._now: dict[str, AnyArray] = {}
        self._named: dict[tuple[str, str], Named] = {}
        self._drafts: dict[str, AnyArray] | None = None  # what `act` reads and writes of WRITABLE

    @property
    def model(self) -> mujoco.MjModel:
        """Model that is simulated, the first if there are several; never changed."""
        return self.engine.model

    @property
    def models(self) -> tuple[mujoco.MjModel, ...]:
        """Models that are simulated, M of them; mostly one."""
        return getattr(self.engine, "models", (self.engine.model,))

    def __len__(self) -> int:
        """B, the rollouts still going."""
        return len(self._ids)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  an array of MjData
        if name.startswith("_"):
            raise AttributeError(name)
        if self._drafts is not None and name in getattr(self.engine, "writable", WRITABLE):
            if name not in self._drafts:
                self._drafts[name] = self.engine.field(name)[self._ids]  # a copy
            return self._drafts[name]
        cached = self._now.get(name)
        if cached is not None:
            return cached
        values = self.engine.field(name)
        if self._live:
            if not values.flags.writeable and not self._stepped:  # states may have been written
                self._constants()
                self.engine.forward(self._ids)
            return values[: len(self)]
        self._now[name] = rows = self._taken(values)
        return rows

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _ATTRIBUTES and not name.startswith("_"):
            raise AttributeError(
                f"sim.{name} is written in place: sim.{name}[:] = ...; keep your values in sim.own"
            )
        super().__setattr__(name, value)

    def _taken(self, values: AnyArray) -> AnyArray:
        """The rows still going, read-only."""
        rows = values[
            self._rows if self._source is None or values.flags.writeable else self._source
        ].view()
        rows.flags.writeable = False
        return rows

    def begin(
        self,
        count: int,
        which: IntArray | None = None,
        seeds: Sequence[Sequence[int] | None] | None = None,
    ) -> None:
        """Begin `count` rollouts at the model's own start, with `which` model each (None: the
        first), and with seeds (None: nominal); arrays can be written until `start`.
        """
        self._ids, self._rows, self._source = np.arange(count), slice(count), None
        several = len(self.models) > 1
        self.which = np.zeros(count, dtype=int) if which is None else which
        if several:
            self.engine.assign(self.which)  # type: ignore[attr-defined]  # it has several models
        self._seeds = seeds or [None] * count
        self._prepared = self._ids
        self._keys = None
        self.own, self.t, self._now = {}, 0, {}
        self._live, self._stepped = True, False
        for name in self._expanded:  # before the reset: what it takes from the model is nominal too
            # The engine may have begun anew, see Rebound
            values = self._expanded[name] = self.engine.expand(name)
            values[:count] = self._nominal[name][self.which if several else 0]
        self.engine.reset(self._ids)
        self._dirty = bool(self._expanded)

    def start(self, sources: IntArray) -> None:
        """End the preparation: B rollouts; rollout i starts in the state of the prepared one
        sources[i].

        Raises:
          TaskError: an entry of `own` is not an array with one row per rollout.
        """
        for name, values in self.own.items():
            if not isinstance(values, np.ndarray) or np.shape(values)[:1] != (len(self),):
                got = (
                    f"shape {values.shape}"
                    if isinstance(values, np.ndarray)
                    else f"a {type(values).__name__}"
                )
                raise TaskError(
                    f"sim.own[{name!r}] is {got}; expected an array of shape ({len(self)}, ...)"
                )
        self.detach()
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
        self._rows = slice(len(sources))
        self._prepared = sources
        self.engine.copy(sources)
        for values in self._expanded.values():
            values[: len(sources)] = values[sources]
        if self._expanded:
            self.engine.set_const(self._ids)
            self._dirty = False
        self.own = {name: values[sources] for name, values in self.own.items()}
        self._source, self.which = sources, self.which[sources]

    def detach(self) -> None:
        """Copy what `own` has of the simulation's arrays, as of `sim.own["last"] = sim.qpos`: they
        change with the next step.
        """
        for name, values in self.own.items():
            if isinstance(values, np.ndarray) and values.base is not None:
                self.own[name] = values.copy()

    def expand(self, name: str) -> AnyArray:
        """A field of MjModel with a value for each rollout, (B, ...); read-only once they are
        prepared.

        Models with fewer geometries (or others) than the largest have nan, or 0 for integers,
        behind them.
        """
        if name not in self._expanded:
            self._nominal[name] = own_values(self.models, name)
            self._expanded[name] = self.engine.expand(name)
        if not self._live:
            values = self._expanded[name][self._ids]
            values.flags.writeable = False
            return values
        self._dirty = True
        return self._expanded[name][: len(self)]

    @property
    def nominal(self) -> BoolArray:
        """Which rollouts have nominal conditions, so no random numbers, (B,)."""
        return np.array([seed is None for seed in self.seeds], dtype=bool)

    @property
    def seeds(self) -> list[Sequence[int] | None]:
        """Seed of each rollout, B of them; None: nominal conditions."""
        return [self._seeds[row] for row in self._prepared[self._ids].tolist()]

    def noise(
        self,
        shape: int | tuple[int, ...] = (),
        stream: str = "",
        kind: Kind = "normal",
        step: int | None = None,
    ) -> FloatArray:
        """Random numbers (B, *shape) of this control step, in `observe`, `act`, `reward` and
        everywhere else.

        They follow from the rollout's seed, `sim.t`, stream and kind alone: whoever asks again gets
        the same ones. Nominal rollouts get zeros. `reward` is called after the step, so its `sim.t`
        is that of the next `observe`.

        Args:
          shape: of a rollout's numbers.
          stream: a name for what they are; another one gives other numbers.
          kind: "normal", with mean 0 and standard deviation 1, or "uniform" from -1 to 1.
          step: a control step; by default this one. With 0 the numbers stay during a rollout.

        Raises:
          TaskError: no such kind, or a shape that is none.

        Example:
          ```python
          import numpy as np

          import farm

          class Noisy(farm.Task):
              def observe(self, sim):  # noise of 0.01 rad; one in ten speeds is 0
                  angles = sim.qpos + 0.01 * sim.noise(sim.qpos.shape[1])
                  there = sim.noise(sim.qvel.shape[1], "drop-outs", "uniform") > -0.8
                  return np.concatenate([angles, there * sim.qvel], axis=1)
          ```
        """
        sizes = (shape,) if isinstance(shape, int) else tuple(shape)
        if kind not in KINDS_OF_NOISE or not all(
            isinstance(n, int | np.integer) and n >= 0 for n in sizes
        ):
            raise TaskError(
                f"sim.noise of shape {shape!r:.60} and kind {kind!r:.20}; expected numbers of at"
                f" least 0, and {' or '.join(KINDS_OF_NOISE)}"
            )
        if self._keys is None:
            self._keys = np.array(
                [0 if seed is None else key(seed) for seed in self._seeds], dtype=np.uint64
            )
            self._still = np.array([seed is None for seed in self._seeds], dtype=bool)
        rows = self._prepared[self._ids]
        values = numbers(
            self._keys[rows], stream, self.t if step is None else step, math.prod(sizes), kind
        )
        values[self._still[rows]] = 0.0
        return values.reshape(len(self), *sizes)

    def step(self, count: int = 1) -> None:
        """Advance all rollouts by physics steps."""
        self._constants()
        self._moved()
        self.engine.step(self._ids, count)

    def play(self, controls: FloatArray) -> None:
        """Advance all rollouts by one physics step for each of the controls, (steps, nu) or (B,
        steps, nu).
        """
        self._constants()
        self._moved()
        self.engine.play(self._ids, np.broadcast_to(controls, (len(self), *controls.shape[-2:])))

    def contact_forces(self) -> FloatArray:
        """Contact forces on every body after the last physics step (MuJoCo's cfrc_ext), (B, nbody,
        6).
        """
        forces = self._now.get("contact_forces")
        if forces is None:
            forces = self._now["contact_forces"] = self.engine.contact_forces(self._ids)
        return forces

    def forward(self) -> None:
        """Compute outputs from the present states, which do not change: after a step outputs are
        one step behind.

        Raises:
          TaskError: `act` calls it, where states may be about to change.
        """
        if self._drafts is not None:
            raise TaskError(
                "sim.forward() in act: call it in observe; act then sees the same outputs"
            )
        self.detach()
        self._constants()
        self._now, self._source = {}, None
        self.engine.forward(self._ids)

    def ray(
        self, points: FloatArray, ways: FloatArray, without: str = ""
    ) -> tuple[FloatArray, IntArray]:
        """Find what rays hit in the present states, by MuJoCo's `mj_ray`.

        Args:
          points: where they begin in the world [m], (3,), (R, 3) or (B, R, 3).
          ways: their directions, likewise.
          without: a body whose geometries they do not hit.

        Returns:
          distances in lengths of the directions, and ids of geometries, (B, R) each; -1 where they
          hit nothing.

        Raises:
          TaskError: there is no such body, a direction is 0, or the backend has no rays.
        """
        rays = (np.atleast_2d(each) for each in np.broadcast_arrays(points, ways))
        rays = tuple(
            np.array(np.broadcast_to(each, (len(self), *each.shape[-2:])), dtype=float)
            for each in rays
        )
        if not np.any(rays[1], axis=-1).all():
            raise TaskError("a ray's direction is 0")
        self._constants()
        return ability(self.engine, "ray")(
            self._ids, *rays, self.body(without).id if without else -1
        )

    def jac(self, body: str, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How points in the world, (3,) or (B, 3), that move with a body move and turn with qvel:
        MuJoCo's `mj_jac`.

        Returns:
          Jacobians of position and of rotation in the present states, (B, 3, nv) each.

        Raises:
          TaskError: there is no such body, or the backend has no Jacobians.
        """
        self._constants()
        where = np.array(np.broadcast_to(points, (len(self), 3)), dtype=float)
        return ability(self.engine, "jac")(self._ids, self.body(body).id, where)

    def joint(self, name: str) -> Named:
        """A joint: qpos, qvel, qacc, xanchor, xaxis ... as MuJoCo's `data.joint(name)`, (B, ...)
        each.
        """
        return self._find("joint", name)

    def body(self, name: str) -> Named:
        """A body: xpos, xquat, xmat, cvel, xfrc_applied ..."""
        return self._find("body", name)

    def geom(self, name: str) -> Named:
        """A geometry: xpos, xmat."""
        return self._find("geom", name)

    def site(self, name: str) -> Named:
        """A site: xpos, xmat."""
        return self._find("site", name)

    def sensor(self, name: str) -> Named:
        """A sensor: data."""
        return self._find("sensor", name)

    def actuator(self, name: str) -> Named:
        """An actuator: ctrl, force, length, velocity."""
        return self._find("actuator", name)

    def tendon(self, name: str) -> Named:
        """A tendon: length, velocity."""
        return self._find("tendon", name)

    def _find(self, kind: str, name: str) -> Named:
        if (kind, name) not in self._named:
            first, *others = (
                Named(self.__getattr__, mujoco.MjData(model), kind, name) for model in self.models
            )
            if any(not first.same(other) for other in others):
                raise TaskError(
                    f"{kind} {name!r} has other places in the arrays of other models: read them by"
                    " sim.which"
                )
            self._named[kind, name] = first
        return self._named[kind, name]

    def control(self, values: FloatArray) -> None:
        """Set the controls, (B, nu)."""
        self.engine.field("ctrl")[self._rows] = values
        self._now.pop("ctrl", None)

    @contextmanager
    def writing(self) -> Iterator[dict[str, AnyArray]]:
        """Let a task write copies of WRITABLE in this block; yields them by name, (n, ...), for
        `write`.

        They are copies whether or not some rollouts have ended, so that one kept for later never
        reaches the physics.
        """
        drafts = self._drafts = {}
        try:
            yield drafts
        finally:
            self._drafts = None
            for values in drafts.values():
                values.flags.writeable = False

    def write(self, states: Mapping[str, AnyArray]) -> None:
        """Write states (n, ...) by name; outputs follow in the next physics step."""
        for name, values in states.items():
            self.engine.field(name)[self._rows] = values
            self._now.pop(name, None)

    def blown_up(self) -> BoolArray:
        """Which rollouts' states are no longer reasonable numbers, (B,)."""
        return self.engine.blown_up(self._ids)

    def keep(self, going: BoolArray) -> None:
        """Remove the finished rollouts, (B,)."""
        self._ids, self._now, self.which = self._ids[going], {}, self.which[going]
        self._rows = as_rows(self._ids)
        self.own = {name: values[going] for name, values in self.own.items()}

    @contextmanager
    def only(self, rows: BoolArray) -> Iterator[None]:
        """Let a task see some of the rollouts, (B,), in this block; what it writes into `own`
        there is lost.
        """
        before = self._ids, self._rows, self._now, self.which, self.own
        self.keep(rows)
        try:
            yield
        finally:
            self._ids, self._rows, self._now, self.which, self.own = before

    def _moved(self) -> None:
        self._now, self._source, self._stepped = {}, None, True

    def _constants(self) -> None:
        """Update derived constants if what they depend on may have been written."""
        if self._dirty:
            self.engine.set_const(self._ids)
            self._dirty = False


def ability(engine: Engine, what: str) -> Any:  # noqa: ANN401  a method that not every engine has
    """A method of an engine; a TaskError if it has none of this name."""
    method = getattr(engine, what, None)
    if method is None:
        raise TaskError(
            f"sim.{what} is not there on this backend: its {type(engine).__name__} has none"
        )
    return method


def as_rows(ids: IntArray) -> slice | IntArray:
    """An index of rows whose ids rise, (n,): a slice if they are the first n, as it is faster and
    needs no copy.
    """
    return slice(len(ids)) if len(ids) and ids[-1] == len(ids) - 1 else ids


def own_value(model: mujoco.MjModel, name: str) -> Any:  # noqa: ANN401  a number or an array
    """A field of the model, or (opt.NAME) of its options.

    Raises:
      TaskError: there is no such field.
    """
    where = model.opt if name.startswith("opt.") else model
    try:
        return getattr(where, name.removeprefix("opt."))
    except AttributeError:
        raise TaskError(f"MuJoCo's model has no field {name!r}") from None


def own_values(models: Sequence[mujoco.MjModel], name: str) -> AnyArray:
    """A model field of every model, padded with nan (integers: 0), (M, ...)."""
    values = [np.asarray(own_value(model, name)) for model in models]
    most = tuple(map(max, zip(*(each.shape for each in values), strict=True)))
    out = np.full(
        (len(values), *most), np.nan if values[0].dtype.kind == "f" else 0, values[0].dtype
    )
    for row, each in enumerate(values):
        out[(row, *(slice(n) for n in each.shape))] = each
    return out


def unwritable(line: str) -> str:
    """Why a line of a task's code cannot write what it names of `sim`, and what can be written
    instead.
    """
    # sim.qpos, or sim.joint("hinge").qpos
    match = re.search(r"\bsim(?:\.\w+\([^)]*\))?\.(\w+)", line)
    if not match:
        return f"the array is read-only; {_CAN}"
    if match[1] == "expand":
        return (
            "a field of the model can be written in reset and prepare only, before the rollout runs"
        )
    if match[1] == "ctrl":
        return "act returns the controls"
    if match[1] in WRITABLE:
        return (
            f"{match[0]} can be written in act, reset and prepare only, and in no environment of"
            " Gymnasium"
        )
    return f"{match[0]} is computed by MuJoCo; {_CAN}"


def warned(engine: Engine, ids: IntArray) -> IntArray:
    """How often MuJoCo has warned of each of `complaints.KINDS` in rows, (n, K); zeros if the
    engine does not count.
    """
    count = getattr(engine, "warned", None)
    return np.zeros((len(ids), len(KINDS)), dtype=int) if count is None else count(ids)


def complaint(engine: Engine) -> str:
    """MuJoCo's words about the last error that ended a row, once; empty without one."""
    tell = getattr(engine, "complaint", None)
    return "" if tell is None else tell()


def failed_rows(state: FloatArray) -> BoolArray:
    """Rows (n, nstate) with a number that is not reasonable, (n,)."""
    return np.asarray(~(np.abs(state) < LIMIT).all(axis=1))
