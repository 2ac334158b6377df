"""A round's jobs by what they are for: exploring, the mean policy, the best rollout again.

Pure.
"""

import itertools

from farm.net.work import Jobs


class Parts:
    """Jobs of a round in named parts, one after another.

    A part without jobs is left out: `name in parts` says whether it is there.
    """

    def __init__(self, **parts: Jobs | None) -> None:
        """Take each part's jobs, in the order of the round."""
        parts_with_jobs = {
            name: jobs for name, jobs in parts.items() if jobs is not None and len(jobs)
        }
        self.jobs: Jobs = Jobs.joined(list(parts_with_jobs.values()))
        """Jobs of all parts."""
        self._jobs = _ranges({name: len(jobs) for name, jobs in parts_with_jobs.items()})
        self._rollouts = _ranges(
            {name: int(jobs.rollouts.sum()) for name, jobs in parts_with_jobs.items()}
        )

    def __contains__(self, name: str) -> bool:
        return name in self._jobs

    def job(self, name: str) -> int | None:
        """Index of a part's first job, or None."""
        return self._jobs[name].start if name in self else None

    def rows(self, name: str) -> slice:
        """Rows of a part's rollouts in the results; a KeyError if the part is not there."""
        return self._rollouts[name]

    def size(self, name: str) -> int:
        """Number of a part's rollouts, 0 if it is not there."""
        return self._rollouts[name].stop - self._rollouts[name].start if name in self else 0


def _ranges(sizes: dict[str, int]) -> dict[str, slice]:
    ends = list(itertools.accumulate(sizes.values()))
    return {
        name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }
