"""Several models in one batch: rows of different models behind one engine."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, TaskError
from farm.sim.engines import check_field
from farm.sim.interfaces import Engine, MakeEngine, Rebound
from farm.sim.model_files import Files, compiled
from farm.sim.quantities import controls
from farm.sim.scene import Scene
from farm.sim.sim import ability, complaint, own_values, warned

T = TypeVar("T")


def engine(models: Sequence[mujoco.MjModel], make: MakeEngine) -> Engine:
    """The engine of models, at least one."""
    return make(models[0]) if len(models) == 1 else MixedEngine(models, make)


def compiled_models(
    models: object, name: str, files: Files, main: str
) -> tuple[mujoco.MjModel, ...]:
    """Models of MJCF texts, or compiled ones, as a task gives them.

    Args:
      models: what it gives.
      name: of the task in messages.
      files: the only files that texts may read, by path.
      main: the texts' own path among them.

    Raises:
      ConfigError: a text cannot be compiled, something is no model, or one cannot be simulated
          beside the others.
    """
    if not isinstance(models, list | tuple) or not all(
        isinstance(each, str | mujoco.MjModel) for each in models
    ):
        raise ConfigError(
            f"task {name}: models gave {models!r:.60}; expected a list of MJCF texts or compiled"
            " models"
        )
    out = tuple(
        compiled(each, name, files, main) if isinstance(each, str) else each for each in models
    )
    check_alike(out)
    return out


def check_alike(models: Sequence[mujoco.MjModel]) -> None:
    """Check that models can be the task of one policy, and be drawn in one scene.

    Raises:
      ConfigError: names the first thing in which one differs from the first.
    """
    tables = [
        {
            "nq": model.nq,
            "nu": model.nu,
            "nmocap": model.nmocap,
            "timestep": model.opt.timestep,
            "joints": [model.joint(i).name for i in range(model.njnt)],
            "actuators": [each.name for each in controls(model)],
            "ctrlrange": model.actuator_ctrlrange.tolist(),
            "ctrllimited": model.actuator_ctrllimited.tolist(),
            "bodies with geometries": Scene(model).bodies,
            "bodies that do not move": sorted(Scene(model).fixed),
        }
        for model in models
    ]
    for name, table in zip(names(models), tables, strict=True):
        for what, value in table.items():
            if value != tables[0][what]:
                raise ConfigError(
                    f"model {name!r} has {what} {value!s:.60}, but the first model"
                    f" {tables[0][what]!s:.60}: models of one task must agree in that"
                )


def names(models: Sequence[mujoco.MjModel]) -> tuple[str, ...]:
    """Names of models, as their MJCF says, or numbers if two are named alike."""
    texts = tuple(model.names.split(b"\0", 1)[0].decode() for model in models)
    return (
        texts
        if len(set(texts)) == len(texts)
        else tuple(str(index) for index in range(len(models)))
    )


@dataclass
class _Part:
    """The engine of the models whose data have one layout."""

    engine: Engine
    models: list[int] = field(default_factory=list)
    """Which of the models, in the order in which the engine knows them"""

    def takes(self, model: mujoco.MjModel) -> bool:
        """Whether the engine can simulate another model beside its own; from then on it does."""
        takes: Callable[[mujoco.MjModel], bool] | None = getattr(self.engine, "takes", None)
        return takes is not None and takes(model)


class MixedEngine:
    """Rows of several models, as `assign` says.

    Models whose data have the same layout share an engine, if it has `takes` and `assign`; others
    have one each. The engine holds each requested array for all rows: it copies states to the parts
    before it calls them, and what they give back afterwards.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], make: MakeEngine) -> None:
        """Make the engines; the first model is the nominal one."""
        self.models, self.model = tuple(models), models[0]
        self._parts: list[_Part] = []
        for index, model in enumerate(models):
            part = next((part for part in self._parts if part.takes(model)), None)
            if part is None:
                part = _Part(make(model))
                self._parts.append(part)
            part.models.append(index)
        self.size = min(part.engine.size for part in self._parts)
        self._place = np.empty((len(models), 2), dtype=int)  # a model's part, and its number there
        for at, part in enumerate(self._parts):
            self._place[part.models] = [[at, number] for number in range(len(part.models))]
        self._which, self._slot = (np.zeros(self.size, dtype=int) for _ in range(2))
        self._host: dict[str, AnyArray] = {}  # (size, ...)
        self._states: list[str] = []  # those of them that can be written
        self._expanded: dict[str, AnyArray] = {}  # (size, ...)

    def assign(self, which: IntArray) -> None:
        """Say which model each of the first rows has, (n,); their states are lost."""
        self._which[: len(which)] = which
        for part, rows, _ in self._split(np.arange(len(which))):
            self._slot[rows] = np.arange(len(rows))
            if len(part.models) > 1:
                part.engine.assign(self._place[which[rows], 1])  # type: ignore[attr-defined]  # as it took them

    def field(self, name: str) -> AnyArray:
        """A live array over all rows."""
        values = self._host.get(name)
        if values is None:
            check_field(name)
            parts = _all(partial(part.engine.field, name) for part in self._parts)
            self._check_shapes(f"sim.{name}", parts)
            values = self._host[name] = np.zeros((self.size, *parts[0].shape[1:]), parts[0].dtype)
            if parts[0].flags.writeable:
                self._states.append(name)
            self._read(np.arange(self.size), [name])
        values = values.view()
        values.flags.writeable = name in self._states
        return values

    def reset(self, ids: IntArray) -> None:
        """Bring rows to their models' own starts."""
        for part, _, slots in self._split(ids):
            part.engine.reset(slots)
        self._read(ids, self._host)

    def step(self, ids: IntArray, count: int) -> None:
        """Advance rows by physics steps."""
        self._call(ids, lambda part, _, slots: part.engine.step(slots, count))

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance rows by one physics step for each of their controls."""
        self._call(ids, lambda part, at, slots: part.engine.play(slots, controls[at]))

    def forward(self, ids: IntArray) -> None:
        """Compute outputs."""
        self._call(ids, lambda part, _, slots: part.engine.forward(slots))

    def copy(self, sources: IntArray) -> None:
        """Give row i the state, and the model, of row sources[i]."""
        self._write(sources)
        slots, which = self._slot[sources], self._which[sources]
        states = {name: self._host[name][sources] for name in self._states}
        self.assign(which)
        for part, at, _ in self._split(np.arange(len(sources))):
            part.engine.copy(slots[at])
        for name, values in states.items():
            self._host[name][: len(sources)] = values

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Rows whose state is no longer a reasonable number."""
        [unstable] = self._gathered(ids, lambda part, _, slots: (part.engine.blown_up(slots),))
        return unstable

    def complaint(self) -> str:
        """MuJoCo's words about an error that ended a row, once; empty without one."""
        return "; ".join(filter(None, [complaint(part.engine) for part in self._parts]))

    def warned(self, ids: IntArray) -> IntArray:
        """How often MuJoCo has warned of each of `complaints.KINDS` in rows, (n, K)."""
        [counts] = self._gathered(ids, lambda part, _, slots: (warned(part.engine, slots),))
        return counts

    def contact_forces(self, ids: IntArray) -> FloatArray:
        """Forces of contacts on every body of rows, (n, nbody, 6)."""
        [forces] = self._gathered(ids, lambda part, _, slots: (part.engine.contact_forces(slots),))
        return forces

    def ray(
        self, ids: IntArray, points: FloatArray, ways: FloatArray, without: int
    ) -> tuple[FloatArray, IntArray]:
        """Distances and geometries that rays (n, R, 3) hit, (n, R) each."""
        self._write(ids)
        return self._gathered(
            ids,
            lambda part, at, slots: ability(part.engine, "ray")(
                slots, points[at], ways[at], without
            ),
        )

    def jac(self, ids: IntArray, body: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobians of points (n, 3) of a body, (n, 3, nv) each."""
        self._write(ids)
        return self._gathered(
            ids, lambda part, at, slots: ability(part.engine, "jac")(slots, body, points[at])
        )

    def expand(self, name: str) -> AnyArray:
        """A field of the models with values for each row; nan, or 0, where a row's model has
        fewer than another.
        """
        if name not in self._expanded:
            for part in self._parts:
                part.engine.expand(name)
            self._expanded[name] = own_values(self.models, name)[self._which]
        return self._expanded[name]

    def set_const(self, ids: IntArray) -> None:
        """Update derived constants."""
        for part, at, slots in self._split(ids):
            for name, values in self._expanded.items():
                field = part.engine.expand(name)
                field[slots] = values[ids[at]][:, *(slice(n) for n in field.shape[1:])]
            part.engine.set_const(slots)

    def close(self) -> None:
        """Release the parts' resources."""
        for part in self._parts:
            part.engine.close()

    def _split(self, ids: IntArray) -> Iterator[tuple[_Part, IntArray, IntArray]]:
        """Each part that has some of these rows: where they are among `ids`, and its own rows for
        them.
        """
        parts = self._place[self._which[ids], 0]
        for index, part in enumerate(self._parts):
            at = np.flatnonzero(parts == index)
            if len(at):
                yield part, at, self._slot[ids[at]]

    def _call(self, ids: IntArray, call: Callable[[_Part, IntArray, IntArray], object]) -> None:
        """Let the parts advance rows."""
        self._write(ids)
        for part, at, slots in self._split(ids):
            call(part, at, slots)
        self._read(ids, self._host)

    def _gathered(
        self, ids: IntArray, call: Callable[[_Part, IntArray, IntArray], tuple[AnyArray, ...]]
    ) -> Any:  # noqa: ANN401
        """Arrays (n, ...) for rows, from those of the parts."""
        pieces = _all(
            partial(lambda part, at, slots: (at, call(part, at, slots)), *each)
            for each in self._split(ids)
        )
        out = []
        for parts in zip(*(values for _, values in pieces), strict=True):
            self._check_shapes("what the engine gives", parts)
            whole = np.empty((len(ids), *parts[0].shape[1:]), parts[0].dtype)
            for (at, _), piece in zip(pieces, parts, strict=True):
                whole[at] = piece
            out.append(whole)
        return tuple(out)

    def _check_shapes(self, what: str, parts: Sequence[AnyArray]) -> None:
        shapes = [values.shape[1:] for values in parts]
        if len(set(shapes)) > 1:
            first = [names(self.models)[part.models[0]] for part in self._parts]
            listing = ", ".join(
                f"{shape} of {name}" for name, shape in zip(first, shapes, strict=False)
            )
            raise TaskError(
                f"{what} has other shapes in other models: {listing}; a task can read arrays of one"
                " shape only"
            )

    def _write(self, ids: IntArray) -> None:
        """Copy the states of rows to the parts."""
        for part, at, slots in self._split(ids):
            for name in self._states:
                part.engine.field(name)[slots] = self._host[name][ids[at]]

    def _read(self, ids: IntArray, names: Iterable[str]) -> None:
        """Copy arrays of rows back."""
        for part, at, slots in self._split(ids):
            for name in names:
                self._host[name][ids[at]] = part.engine.field(name)[slots]


def _all(calls: Iterable[Callable[[], T]]) -> list[T]:
    """What the calls give; all are made before one of them lets the batch start again."""
    out, rebound = [], False
    for call in calls:
        try:
            out.append(call())
        except Rebound:
            rebound = True
    if rebound:
        raise Rebound
    return out
