"""Steps that shrink when validation no longer improves. Pure.

A search with constant steps goes on to wander about the top of the hill that it has found. So after
some validations in succession without a better score its steps are halved, and the count begins
anew.
"""

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Shrinking:
    """What the validations so far say of the steps."""

    waited: int = 0
    """Validations since the best one, or since steps were halved."""
    halvings: int = 0
    """How often steps were halved."""

    def after(self, *, better: bool, patience: int) -> "Shrinking":
        """What follows from a validation.

        Args:
          better: whether it was better than all before.
          patience: validations in succession that may not be; 0: any number.
        """
        if better or not patience:
            return replace(self, waited=0)
        if self.waited + 1 < patience:
            return replace(self, waited=self.waited + 1)
        return Shrinking(halvings=self.halvings + 1)

    @property
    def share(self) -> float:
        """Length of a step, in those of the beginning."""
        return 0.5**self.halvings
