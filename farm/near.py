"""Suggestions for mistyped words."""

import difflib
from collections.abc import Iterable

_LONGEST = 80  # characters that are compared


def nearest(word: str, known: Iterable[str]) -> str:
    """The known word most like this one; empty if none is like it.

    Example:
      ```python
      from farm.near import nearest

      assert nearest("rnu", ["run", "learner"]) == "run"
      ```
    """
    return next(iter(difflib.get_close_matches(word[:_LONGEST], list(known), 1)), "")


def meant(word: str, known: Iterable[str]) -> str:
    """The end of a message on a mistyped word, `; did you mean X?`, or nothing."""
    near = nearest(word, known)
    return f"; did you mean {near}?" if near else ""
