"""States of a run from before the first answers of its hosts: where it goes back to when one is
expelled.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from farm.errors import RunError
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import Checkpoint

MOST: Final = 32
"""States that are kept; of more, those go that are close to the one before."""


class RolledBack(RunError):  # noqa: N818  not an error of the user's
    """The state contains results of an expelled host; resuming repeats those generations."""


@dataclass(frozen=True)
class States:
    """Checkpoints in a folder, each in a file named after its number of generations."""

    path: Path

    def keep(self, at: Checkpoint) -> None:
        """Keep the state before a generation in which a host answers for the first time."""
        self.path.mkdir(exist_ok=True)
        path = self._file(at.state["generation"])
        checkpoints.save(path, at)
        checkpoints.flush(path)
        generations = self._generations()
        if len(generations) > MOST:
            gaps = {
                generations[i]: generations[i + 1] - generations[i - 1]
                for i in range(1, len(generations) - 1)
            }
            self._file(min(gaps, key=lambda each: gaps[each])).unlink()

    def without(self, at: Checkpoint) -> Checkpoint:
        """The latest state without numbers of hosts that are expelled.

        This one itself if it has none.

        Raises:
          CheckpointError: there is none any more.
        """
        generation = goes_back_to(at)
        if generation is None:
            return at
        generations = [each for each in self._generations() if each <= generation]
        earlier = checkpoints.load(self._file(generations[-1] if generations else 0))
        return replace(
            earlier,
            config=at.config,
            expelled=at.expelled,
            seconds=at.seconds,
            reissued=at.reissued,
            undone=at.undone + at.state["generation"] - earlier.state["generation"],
        )

    def forget_after(self, generation: int) -> None:
        """Remove later states, which the run makes again."""
        for each in self._generations():
            if each > generation:
                self._file(each).unlink()

    def _file(self, generation: int) -> Path:
        return self.path / str(generation)

    def _generations(self) -> list[int]:
        names = (each.name for each in self.path.iterdir()) if self.path.is_dir() else ()
        return sorted(int(name) for name in names if name.isdecimal())


def goes_back_to(at: Checkpoint) -> int | None:
    """The generation before the first answer of an expelled host; None if no such answer is in the
    state.
    """
    first = [at.first[name] for name in at.expelled if name in at.first]
    return min(first) if first and min(first) < at.state["generation"] else None
