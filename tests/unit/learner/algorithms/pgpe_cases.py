"""Settings of PGPE that are tried together, and states from which an update begins."""

import dataclasses
from typing import get_args, get_type_hints

import numpy as np
from covering import covering, product

from learner.algorithms import PGPE

CHOICES = {name: get_args(hint) for name, hint in get_type_hints(PGPE).items() if get_args(hint)}
ALL = product(CHOICES)


def cases(strength=2, of=ALL):
    """Cases in which the values of any two settings occur together, or of three, beside each
    shaping of returns.

    With ranks neither baseline nor normaliser counts: two settings that meet only there would hide
    what they do.
    """
    return [
        case
        for shaping in CHOICES["shaping"]
        for case in covering([each for each in of if each["shaping"] == shaping], strength)
    ]


def name_of(choices):
    return "-".join(choices.values())


def state_of(config, mu, sigma, **others):
    empty = config.init(len(mu))
    return dataclasses.replace(empty, mu=np.array(mu), sigma=np.array(sigma), **others)


def sample(seed, config, size=3):
    """Return a state in the middle of a run, eps and returns."""
    rng = np.random.default_rng(seed)
    state = dataclasses.replace(config.init(size), best=1.5, baseline=-3.0, generation=4)
    return state, config.ask(state, rng), rng.normal(-4.0, 3.0, config.returns_shape)
