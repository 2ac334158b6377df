"""Set-ups, the configurations of the thesis' experiments by name, with what one trial of each
takes.

They are the preset `thesis` with the settings given in the figure's caption and in the text. Other
settings keep the preset's value (docs/method.md lists what the thesis leaves open).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, Final

from learner.algorithms.pgpe import PGPE
from learner.run.config import RunConfig, configure
from learner.run.setup import fitted

OBJECTS: Final = ("bar", "thin-bar", "thick-bar", "cylinder", "bolt")


def setup(preset: str, **settings: Any) -> RunConfig:  # noqa: ANN401  values of any setting
    """A preset with some settings changed, each by its flag's name."""
    return configure("finger-gait", preset, traces="none", **settings)


def _projected(state: str, features: int, **settings: Any) -> RunConfig:  # noqa: ANN401
    return setup("thesis", state=state, features=features, **settings)


def _direct(state: str, features: int, **settings: Any) -> RunConfig:  # noqa: ANN401
    options = {"weights": "direct", "clip": False, **settings}
    return setup("thesis", policy="direct", state=state, features=features, **options)


_FORMER: Final[Mapping[str, Any]] = {
    "pairs": 15,
    "initial_mu": 1.75,
    "initial_sigma": 0.8,
    "learning_rate_mu": 0.1,
    "learning_rate_sigma": 0.2,
    "sigma_floor": 1e-3,
    "generations": 150,
}
"""The preset `default` as it was when the experiments were made."""

_FORMER_EXPONENT: Final = 2.0
"""Of the kernel at the fitted start, when the experiments were made."""


def _default(**settings: Any) -> RunConfig:  # noqa: ANN401
    return setup("default", **{**_FORMER, **settings})


WIDE: Final = ("contacts-D1500", "joints-tactile-D5400")
_THIRTY: Final = (
    "joints-D1500",
    "contacts-D1500-30",
    "joints-tactile-D5400-30",
    "contacts-D1500-N50",
)
"""With a fitted start, of 30 trials each."""
_ACCURATE: Final = ("joints-D1600", "contacts-D3400", "tactile-D10800", "joints-tactile-D12600")
EARLY: Final[Mapping[str, str]] = {
    "joints": "early-joints",
    "joints+contacts": "early-contacts",
    "tactile": "early-tactile",
    "joints+tactile": "early-joints-tactile",
}
"""Set-ups of 1500 rollouts, by state base."""

_BETWEEN: Final = tuple(f"between-{name}" for name in OBJECTS)

_RELEASE: Final = {"start_grip": "index+middle+thumb", "goal_grip": "index+thumb"}


SETUPS: Final[dict[str, RunConfig]] = {
    "joints-D300-30": _projected("joints", 300),
    "joints-D1500": _projected("joints", 1500),
    # This one was made at a later commit than the others, which rounds differently
    "joints-D1500-30": _projected("joints", 1500),
    "joints-D8000": _projected("joints", 8000),
    "joints-D8000-30": _projected("joints", 8000),
    "joints-D8000-returns-x128": _projected("joints", 8000, return_scale=12.8),
    "joints-D8000-returns-x100": _projected("joints", 8000, return_scale=10.0),
    "contacts-D1500": _projected("joints+contacts", 1500),
    "contacts-D1500-30": _projected("joints+contacts", 1500),
    "contacts-D1500-N50": _projected("joints+contacts", 1500, pairs=50),
    "joints-tactile-D5400": _projected("joints+tactile", 5400),
    "joints-tactile-D5400-30": _projected("joints+tactile", 5400),
    "direct-contacts-N50": _direct("joints+contacts", 100, pairs=50),
    "direct-contacts-N50-clipped": _direct("joints+contacts", 100, pairs=50, clip=True),
    "direct-contacts-N50-limited": _direct("joints+contacts", 100, pairs=50, reward="limited"),
    "direct-contacts-N50-both": _direct(
        "joints+contacts", 100, pairs=50, clip=True, reward="limited"
    ),
    "direct-contacts-N50-low": _direct(
        "joints+contacts", 100, pairs=50, initial_mu=0.1, initial_sigma=0.2
    ),
    "direct-contacts-N50-derived": _direct("joints+contacts", 100, pairs=50, normaliser="sehnke"),
    "direct-contacts-N50-plain": _direct("joints+contacts", 100, pairs=50, estimator="plain"),
    "direct-contacts-N15-short": _direct("joints+contacts", 100, pairs=15, generations=133),
    "direct-contacts-N25-short": _direct("joints+contacts", 100, pairs=25, generations=80),
    "direct-contacts-N50-short": _direct("joints+contacts", 100, pairs=50, generations=40),
    "direct-contacts-N100-short": _direct("joints+contacts", 100, pairs=100, generations=20),
    "direct-joints-N5": _direct("joints", 100, pairs=5, generations=450),
    "direct-joints-N15": _direct("joints", 100, pairs=15),
    "direct-joints-N50": _direct("joints", 100, pairs=50, generations=45),
    "cosine-joints-D100": setup("thesis", policy="cosine", features=100),
    "cosine-joints-D1500": setup("thesis", policy="cosine", features=1500),
    "direct-joints-N15-projected-weights": _direct("joints", 100, weights="projected"),
    "joints-D1600": _projected("joints", 1600),
    "contacts-D3400": _projected("joints+contacts", 3400),
    "tactile-D10800": _projected("tactile", 10800),
    "joints-tactile-D12600": _projected("joints+tactile", 12600),
    "joints-kernel-30": setup("thesis", policy="kernel"),
    "default-contacts": _default(state="joints+contacts"),
    **{name: _default(state=state, generations=50) for state, name in EARLY.items()},
    "default-contacts-h2": _default(state="joints+contacts", bandwidth=2.0),
    "default-contacts-x0.3": _default(state="joints+contacts", contacts_scale=0.3),
    "default-contacts-x0.1": _default(state="joints+contacts", contacts_scale=0.1),
    "joints-D8000-near": _projected("joints", 8000, initial_mu=1.75, initial_sigma=0.8),
    "joints-D8000-capped": _projected("joints", 8000, sigma_rule="capped"),
    "joints-D8000-near-capped": _projected(
        "joints", 8000, initial_mu=1.75, initial_sigma=0.8, sigma_rule="capped"
    ),
    "joints-D8000-sehnke": _projected("joints", 8000, normaliser="sehnke"),
    "default-bar": _default(object="bar"),
    # These were made at a later commit, which rounds differently
    **{f"object-{name}": _default(object=name) for name in OBJECTS},
    **{
        f"between-{name}": _default(object=name, pose="between", generations=50) for name in OBJECTS
    },
    "default-direct": _default(policy="direct", features=100, initial_mu=0.0, initial_sigma=0.1),
    "release-kernel": _default(**_RELEASE),
    "release-direct": _default(
        policy="direct", features=100, initial_mu=0.0, initial_sigma=0.1, **_RELEASE
    ),
    "default-optimal-baseline": _default(baseline="optimal"),
    "default-no-baseline": _default(baseline="none"),
    "default-plain": _default(estimator="plain"),
    "default-plain-optimal-baseline": _default(estimator="plain", baseline="optimal"),
}
"""Configurations by name.

A run has one of them and a seed; all experiments that show this run share it.
"""

FITTED: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    f"{name}-{suffix}": (name, parts)
    for suffix, names, parts in (
        (
            "fitted",
            (*_THIRTY, *WIDE, *_ACCURATE, *EARLY.values(), *_BETWEEN),
            ("bandwidth", "initial_sigma"),
        ),
        ("width", WIDE, ("bandwidth",)),
        ("sigma", WIDE, ("initial_sigma",)),
    )
    for name in names
}
"""Set-ups with a fitted start: name -> the original set-up, and which of bandwidth and initial
sigma are fitted.
"""


@cache
def config(name: str) -> RunConfig:
    """The configuration of a set-up."""
    if name in SETUPS:
        return SETUPS[name]
    base, parts = FITTED[name]
    fit: Any = fitted(replace(SETUPS[base], start="fitted"), _FORMER_EXPONENT)
    plain: Any = SETUPS[base]
    policy, algorithm = plain.policy_config, plain.algorithm_config
    if "bandwidth" in parts:
        policy = replace(policy, bandwidth=fit.policy_config.bandwidth)
    if "initial_sigma" in parts:
        algorithm = replace(algorithm, initial_sigma=fit.algorithm_config.initial_sigma)
    return replace(plain, policy_config=policy, algorithm_config=algorithm)


RATES: Final = {"direct": 600.0, "cosine": 600.0, "kernel": 550.0, "projected": 2.4e6}
"""Rollouts per second on two cores (for `projected`, multiplied by the number of features), for
estimates of time.
"""


def _cheap(name: str) -> RunConfig:
    """A configuration that takes as long as the set-up's, for estimates of time."""
    return SETUPS[FITTED[name][0] if name in FITTED else name]


def rollouts(name: str) -> int:
    """Number of exploring rollouts in one trial of a set-up."""
    config = _cheap(name)
    assert isinstance(config.algorithm_config, PGPE)
    return 2 * config.algorithm_config.pairs * config.generations


def minutes(names: tuple[str, ...]) -> float:
    """Estimated duration of one trial of each set-up on two cores [min]."""
    seconds = 0.0
    for name in names:
        config = _cheap(name)
        rate = RATES[config.policy]
        if config.policy == "projected":
            rate = min(550.0, rate / config.policy_config.features)  # type: ignore[attr-defined]
        seconds += rollouts(name) / rate + 2.0
    return seconds / 60
