"""What is left of finished runs: their folders and policies, and rollouts of these again."""

from collections.abc import Callable

from processes import Farm

from learner.run.folder import RunFolder
from learner.tools.replay.loaded import LoadedPolicy, Replay, load

GENERATIONS = 6
"""Of the run `a`."""
Say = Callable[..., str]


def folder(farm: Farm, name: str = "a") -> RunFolder:
    return RunFolder.open(farm.folder / "runs" / name)


def stored(
    farm: Farm, name: str = "a", generation: int | None = None, **changed: object
) -> LoadedPolicy:
    return load(folder(farm, name).path, generation, **changed)


def again(farm: Farm, name: str = "a", generation: int | None = None, **changed: object) -> Replay:
    return stored(farm, name, generation, **changed).rollout()
