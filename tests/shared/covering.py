"""Fewer cases than a full product that still try every few settings together."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any


def product(choices: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """Every combination of the values of settings."""
    return [
        dict(zip(choices, values, strict=True)) for values in itertools.product(*choices.values())
    ]


def together(case: Mapping[str, Any], strength: int) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Values of a case, this many at a time."""
    return itertools.combinations(case.items(), strength)


def any_two(**choices: Iterable[Any]) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Names and cases for `pytest.mark.parametrize`, in which every two values of two settings
    occur together.
    """
    return tuple(choices), [tuple(case.values()) for case in covering(product(choices), 2)]


def covering(cases: Sequence[dict[str, Any]], strength: int) -> list[dict[str, Any]]:
    """Some of the cases, in which all values of `strength` settings occur together that do so in
    any case.

    Each time the first case that adds most is taken, so the choice is always the same.
    """
    missing = {each for case in cases for each in together(case, strength)}
    selection = []
    while missing:
        selection.append(
            max(cases, key=lambda case: len(missing.intersection(together(case, strength))))
        )
        missing.difference_update(together(selection[-1], strength))
    return selection
