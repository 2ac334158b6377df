"""What `farm tune` tries: policies, algorithms, step sizes and numbers of pairs.

A portfolio is a class with `entries`: settings by the flags' names with underscores, by the entry's
name. An entry replaces settings of the task's first preset, and parts that it names begin with
their own defaults.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, Protocol

from farm import plugins
from farm.errors import ConfigError

_LINEAR: Final = {"policy": "linear", "normalise": True}


class Portfolio(Protocol):
    """A portfolio, of the kind that `--portfolio FILE.py:CLASS` names."""

    entries: ClassVar[Mapping[str, Mapping[str, Any]]]
    """Settings of each entry."""


class General:
    """The task's own settings, random features, linear policies with small and large steps, and a
    small network.

    The network is small, because a larger one takes more rollouts than most races have.
    """

    entries: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {},
        "direct-snes": {"policy": "direct", "features": 50, "algorithm": "snes"},
        "linear-ars": {**_LINEAR, "algorithm": "ars"},
        "linear-ars-large": {
            **_LINEAR,
            "algorithm": "ars",
            "initial_sigma": 0.1,
            "learning_rate_mu": 0.1,
        },
        "linear-es": {**_LINEAR, "algorithm": "es"},
        "mlp-es": {
            "policy": "mlp",
            "layers": (8, 8),
            "algorithm": "es",
            "pairs": 40,
            "weight_decay": 0.0,
        },
    }


def portfolio(name: str) -> Mapping[str, Mapping[str, Any]]:
    """The entries of a portfolio: a name, or FILE.py:CLASS; a ConfigError if there is none, or
    it is malformed.
    """
    entries = getattr(plugins.find("portfolios", name).target, "entries", None)
    if (
        not isinstance(entries, Mapping)
        or not entries
        or not all(isinstance(each, Mapping) for each in entries.values())
    ):
        raise ConfigError(
            f"entries of portfolio {name}: expected tables of settings by name, one or more"
        )
    return entries
