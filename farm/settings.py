"""Settings as dataclasses: checked, and read from JSON; flags of a command line are in
`farm.command_line`.
"""

import dataclasses
import functools
import json
import math
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Literal,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from farm.errors import ConfigError

C = TypeVar("C")

if TYPE_CHECKING:
    Texts: TypeAlias = str | tuple[str, ...]
    """One text, or several: its flag can be repeated.

    The dataclass itself makes it one or the other.
    """
else:
    Texts = tuple[str, ...]

_JSON: Final = 64 << 20  # [bytes] of a file that is read as a whole


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of frozen, keyword-only settings; every value is checked against its annotation and
    bounds.

    Raises:
      ConfigError: names the first value that is invalid, and what was expected.

    Example:
      ```python
      from dataclasses import dataclass

      import farm

      @dataclass(frozen=True, kw_only=True)
      class Climb(farm.Settings):
          rate: float = farm.setting(0.1, above=0.0)
          '''Length of a step.'''

      assert Climb(rate=1).rate == 1.0
      ```
    """

    def __post_init__(self) -> None:
        check(self)


def setting(
    default: Any,  # noqa: ANN401  of the field's type
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:  # noqa: ANN401  a dataclass field, as dataclasses.field is typed
    """A field with bounds: inclusive (least, most) or exclusive (above, below).

    A value beyond them is a ConfigError of the dataclass, a `farm.Settings`.

    Example:
      ```python
      import farm

      share = farm.setting(0.5, above=0.0, most=1.0)  # a field of a dataclass: share: float = ...
      assert share.default == 0.5
      ```
    """
    return field(default=default, metadata={"bounds": (least, most, above, below)})


def check(settings: Any) -> None:  # noqa: ANN401  any frozen dataclass
    """Check each field of a frozen dataclass by its annotation and bounds; integers for float
    fields become floats.

    Raises:
      ConfigError: names the first invalid value and the expected ones.
    """
    annotations = hints(type(settings))
    for each in dataclasses.fields(settings):
        value = getattr(settings, each.name)
        kinds = _kinds(annotations[each.name])
        if type(value) is int and float in kinds and int not in kinds:
            value = _as_float(value)
            object.__setattr__(settings, each.name, value)
        _check_kind(each.name, value, annotations[each.name], kinds)
        if "bounds" in each.metadata and value is not None:
            _check_bounds(each.name, value, *each.metadata["bounds"])


def _as_float(value: int) -> float:
    """A whole number as a float; infinite if it is larger than any."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


@functools.cache
def hints(kind: type) -> dict[str, Any]:
    """Annotations of a dataclass, by field."""
    try:
        return get_type_hints(kind)
    except NameError as error:
        raise ConfigError(f"settings {kind.__qualname__}: {error}") from None


def _kinds(hint: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """The types a value may have; empty if it may have any."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        parts = [_kinds(part) for part in get_args(hint)]
        return tuple(kind for part in parts for kind in part) if all(parts) else ()
    if origin is Literal:
        return (str,)
    kind = origin or hint
    return (kind,) if kind in (int, float, bool, str, tuple, type(None)) else ()


def _check_kind(name: str, value: object, hint: Any, kinds: tuple[Any, ...]) -> None:  # noqa: ANN401
    if kinds and type(value) not in kinds:
        names = ("nothing" if kind is type(None) else kind.__name__ for kind in kinds)
        raise ConfigError(f"{flag(name)} is {value!r}; expected {' or '.join(names)}")
    choices = [
        choice
        for part in (hint, *get_args(hint))
        if get_origin(part) is Literal
        for choice in get_args(part)
    ]
    if choices and value is not None and value not in choices:
        raise ConfigError(
            f"unknown {flag(name)} {value!r}; known are {', '.join(map(str, choices))}"
        )
    if type(value) is float and not math.isfinite(value):
        raise ConfigError(f"{flag(name)} is {value}; expected a finite number")


def _check_bounds(
    name: str,
    value: float,
    least: float | None,
    most: float | None,
    above: float | None,
    below: float | None,
) -> None:
    inside = (
        (least is None or value >= least)
        and (most is None or value <= most)
        and (above is None or value > above)
        and (below is None or value < below)
    )
    if inside:
        return
    if least is not None and most is not None:
        expected = (
            f"{least:g} to {most:g}" if max(abs(least), abs(most)) < 1e6 else f"{least} to {most}"
        )
    else:
        parts = [
            *([] if least is None else [f"{least:g} or more"]),
            *(
                []
                if above is None
                else ["a positive number" if above == 0 else f"more than {above:g}"]
            ),
            *([] if most is None else [f"at most {most:g}"]),
            *([] if below is None else [f"less than {below:g}"]),
        ]
        expected = ", ".join(parts)
    raise ConfigError(f"{flag(name)} is {value}; expected {expected}")


def flag(name: str) -> str:
    """A setting's name as a flag has it, without the dashes before."""
    return name.replace("_", "-")


def to_dict(settings: Any) -> dict[str, Any]:  # noqa: ANN401  any dataclass
    """Every field by its name, as a JSON table."""
    return dataclasses.asdict(settings)


def from_dict(kind: type[C], values: object, where: str) -> C:
    """Settings from a JSON table; missing ones keep their defaults.

    Raises:
      ConfigError: an unknown name, a wrong type or an invalid value; the message begins with
          `where`.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} is {str(values)[:80]!r}; expected a table of settings")
    names = {each.name: each for each in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = [str(name)[:80] for name in values if name not in names]
    if unknown:
        raise ConfigError(
            f"{where}: unknown setting {', '.join(unknown)}; known are {', '.join(names) or 'none'}"
        )
    annotations = hints(kind)  # type: ignore[arg-type]
    arguments = {name: _natural(value, annotations[name]) for name, value in values.items()}
    try:
        return kind(**arguments)
    except (ConfigError, TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: {error}") from None


def _natural(value: object, hint: Any) -> object:  # noqa: ANN401
    """Convert a JSON value for the annotation: whole numbers to floats, lists to tuples."""
    if type(value) is list:
        return tuple(value)
    return (
        _as_float(value)
        if type(value) is int and float in _kinds(hint) and int not in _kinds(hint)
        else value
    )


def read_json(
    path: Path, version: int | None = None, kinds: Mapping[str, type] = types.MappingProxyType({})
) -> Any:  # noqa: ANN401  a dataclass field, as dataclasses.field is typed
    """Read a JSON file.

    With a version: a table of that version, in which some entries have these types.

    Raises:
      ConfigError: it cannot be read, is not JSON, of another version, or lacks an entry.
    """
    try:
        if (size := path.stat().st_size) > _JSON:
            raise ConfigError(f"{path} has {size >> 20} MiB; at most {_JSON >> 20} are read")
        values = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not JSON: {error}") from None
    if version is not None and not (isinstance(values, dict) and values.get("version") == version):
        raise ConfigError(f"{path} is not of version {version}")
    if damaged := [name for name, kind in kinds.items() if type(values.get(name)) is not kind]:
        raise ConfigError(f"{path} is damaged: {', '.join(damaged)}")
    return values
