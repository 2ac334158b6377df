"""What went wrong in rollouts: errors of their code, and what MuJoCo warned of."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from farm.errors import FarmError

NOT_OF_TASK: Final = (FarmError, MemoryError, OSError, ImportError)
"""Errors that never count as a failed rollout: another machine might not raise them, or no rollout
can be right.
"""


@dataclass
class Trouble:
    """What went wrong in rollouts, beside physics that became unstable by itself."""

    errors: list[Exception] = field(default_factory=list)
    """Why rollouts failed, in their order."""
    warned: Counter[str] = field(default_factory=Counter)
    """Number of rollouts in which MuJoCo warned of each of `complaints.KINDS`."""

    def add(self, other: "Trouble") -> None:
        """Add the trouble of other rollouts."""
        self.errors += other.errors
        self.warned += other.warned
