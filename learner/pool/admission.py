"""Which workers a run admits.

Pure.
"""

from collections.abc import Mapping
from typing import Final

from farm.net.messages import WorkRequest

_SHOWN: Final = 8  # characters of a fingerprint, as `farm status` shows them

NOBODY: Final[Mapping[str, str]] = {}
"""Expelled hosts with their reasons: none."""


def host(worker: str) -> str:
    """The part of a worker's name that all workers of its host share."""
    return worker.partition("/")[0]


class Admission:
    """Admits or refuses workers by the properties in their requests for work."""

    def __init__(
        self, fingerprint: str, expelled: Mapping[str, str] = NOBODY, *, any_rounding: bool = False
    ) -> None:
        """Set the rules of a run.

        Args:
          fingerprint: that of the run's machines, or how it begins. The learner's side says it,
            and no worker: the first to answer could shut out all others.
          expelled: hosts that have returned wrong numbers to this run, and the reasons.
          any_rounding: also admit machines that round differently: the run is then not
              reproducible.
        """
        self.any_rounding = any_rounding
        self.fingerprint = fingerprint
        self.expelled: dict[str, str] = dict(expelled)
        """Hosts with wrong numbers, and why."""

    def refusal(self, want: WorkRequest) -> str | None:
        """Why this worker may not take part, None if it may."""
        if reason := self.expelled.get(host(want.worker)):
            return reason
        if not want.fingerprint and not self.any_rounding:
            return (
                "it is a device, whose results cannot be repeated: start the learner with"
                " --any-rounding; the run is then not reproducible"
            )
        if want.fingerprint.startswith(self.fingerprint) or self.any_rounding:
            return None
        fingerprint = want.fingerprint[:_SHOWN]
        return (
            f"its machine rounds differently (fingerprint {fingerprint}, the run's is"
            f" {self.fingerprint[:_SHOWN]}: another processor or library): use a machine like the"
            f" learner's, begin a run with --fingerprint {fingerprint} for machines like this one,"
            " or start the learner with --any-rounding; the run is then not reproducible"
        )
