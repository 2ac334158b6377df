"""The words of a command line before they are parsed: short forms, underscores, flags that are on
or off.
"""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

from farm.errors import ConfigError

SHORT: Final[Mapping[str, str]] = {
    "generations": "-g",
    "name": "-n",
    "out": "-o",
    "quiet": "-q",
    "seed": "-s",
    "task": "-t",
    "workers": "-w",
}
"""Short forms of flags, the same in every command that has the flag."""

HELP: Final = ("-h", "--help", "--help-all")
"""Flags that ask for the help of a command."""

_LONG: Final = {short: f"--{name}" for name, short in SHORT.items()}
_SWITCH: Final = {"true": True, "false": False}


def long(words: Sequence[str]) -> list[str]:
    """The words with long flags for short ones, and dashes for underscores in names of flags.

    Example:
      ```python
      from farm.flags import long

      assert long(["-w", "4", "--step_size=0.1"]) == ["--workers", "4", "--step-size=0.1"]
      ```
    """
    return [_long(word) for word in words]


def _long(word: str) -> str:
    name, equals, value = word.partition("=")
    if name.startswith("--"):
        name = name.replace("_", "-")
    return _LONG.get(name, name) + equals + value


def switched(words: Sequence[str], settings: Any, program: str) -> list[str]:  # noqa: ANN401
    """The words without switches that say what holds anyway.

    A switch is the flag of a setting that is true or false: `--X` turns it on, `--no-X` turns off
    one that may be on by default, and `--X=true` or `--X=false` says it whatever the default is.
    The last one counts.

    Args:
      words: with long flags.
      settings: the defaults: a dataclass or an instance of one, nested ones among its fields.
      program: whose help a message names.

    Raises:
      ConfigError: `--no-X` for what is off in every default, or a value that is neither true nor
        false.
    """
    switches = list(_switches(settings))
    defaults = {name: on for name, on, _ in switches}
    never = {name for name, _, off in switches if off}
    out: list[str | None] = []
    last: dict[str, int] = {}
    for word in words:
        switch = _switch(word, defaults, never, program)
        if switch is None:
            out.append(word)
            continue
        name, on = switch
        if name in last:
            out[last[name]] = None
        last[name] = len(out)
        out.append(None if on == defaults[name] else f"--{name}" if on else f"--no-{name}")
    return [word for word in out if word is not None]


def _switch(
    word: str, defaults: Collection[str], never: Collection[str], program: str
) -> tuple[str, bool] | None:
    """The switch that a word is, and what the word says; None for other words. `never` are names of
    switches that are off unless they are given.
    """
    flag, equals, value = word.partition("=")
    if not flag.startswith("--"):
        return None
    name = flag[2:]
    if name in defaults:
        if equals and value.lower() not in _SWITCH:
            raise ConfigError(f"{flag}={value}: expected true or false (see {program} --help)")
        return name, _SWITCH[value.lower()] if equals else True
    off = name.removeprefix("no-")
    if off == name or off not in defaults:
        return None
    if equals:
        raise ConfigError(f"{word}: {flag} takes no value (see {program} --help)")
    if off in never:
        raise ConfigError(f"{flag}: --{off} is off unless it is given: leave {flag} out")
    return off, False


def _switches(settings: Any) -> Iterator[tuple[str, bool, bool]]:  # noqa: ANN401
    """Names of all flags that are on or off, their defaults, and whether they are off in every
    default: a preset or a saved run may have turned off what others have on.
    """
    kind = settings if isinstance(settings, type) else type(settings)
    for each in dataclasses.fields(settings):
        value = default(settings, each)
        if isinstance(value, bool):
            yield each.name.replace("_", "-"), value, not value and default(kind, each) is False
        elif dataclasses.is_dataclass(value):
            yield from _switches(value)


def default(settings: Any, field: "dataclasses.Field[Any]") -> Any:  # noqa: ANN401
    """The value of a field in a dataclass's instance, or its default in a class.

    Without one: the field's class, if that is a dataclass; else dataclasses.MISSING.
    """
    if not isinstance(settings, type):
        return getattr(settings, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.type if dataclasses.is_dataclass(field.type) else dataclasses.MISSING
