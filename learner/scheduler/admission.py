"""Who may take part in a run: workers that simulate the same thing and round the same way. Pure."""

from farm.net.messages import Want


class Admission:
    """Judges workers by what they say of themselves when they ask for work."""

    def __init__(self, assets: str, canary: str | None, *, mixed: bool = False) -> None:
        """Know the run.

        Args:
          assets: digest of the hand and the objects.
          canary: digest of the numbers that the run's machines give; None until the first worker says it.
          mixed: admit machines whose numbers differ: the run's numbers are then not to be had again.
        """
        self._assets, self._mixed, self._settled = assets, mixed, canary is not None
        self.canary = canary
        """The digest that the run's numbers belong to, None as long as nobody has worked."""

    def refusal(self, want: Want) -> str | None:
        """Why this worker may not take part, None if it may; the first one decides whose numbers count."""
        if want.assets != self._assets:
            return f"its hand or objects are others (release {want.version}): install the learner's release there"
        if self.canary is None:
            self.canary = want.canary
        if want.canary != self.canary and not self._mixed:
            return (
                "its machine rounds differently from those the run began with (another processor or library): "
                "take a machine like them, or start the learner with --mixed and do without repeatable numbers"
            )
        return None

    def counted(self) -> None:
        """A result counted: the run has its numbers for good."""
        self._settled = True

    def deserted(self) -> None:
        """Nobody is left; as long as no result counted, whoever comes next decides."""
        if not self._settled:
            self.canary = None
