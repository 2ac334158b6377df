"""rolloutfarm: policy search on any task, with MuJoCo rollouts from as many workers as you like.

The public names; each is loaded when it is used.
"""

from typing import TYPE_CHECKING, Any, Final

__version__ = "0.3.0"

if TYPE_CHECKING:
    from farm.environments import environment as environment
    from farm.errors import CheckpointError as CheckpointError
    from farm.errors import ConfigError as ConfigError
    from farm.errors import FarmError as FarmError
    from farm.errors import RunError as RunError
    from farm.errors import TaskError as TaskError
    from farm.policies.base import Policy as Policy
    from farm.policies.base import PolicyConfig as PolicyConfig
    from farm.settings import Settings as Settings
    from farm.settings import setting as setting
    from farm.sim.channels import Camera as Camera
    from farm.sim.channels import Channel as Channel
    from farm.sim.channels import Measure as Measure
    from farm.sim.channels import Quantity as Quantity
    from farm.sim.interfaces import Backend as Backend
    from farm.sim.sim import Sim as Sim
    from farm.tasks.actions.clock import Clock as Clock
    from farm.tasks.actions.mirrored import Mirrored as Mirrored
    from farm.tasks.actions.moves import Moves as Moves
    from farm.tasks.actions.offsets import Offsets as Offsets
    from farm.tasks.actions.residual import Residual as Residual
    from farm.tasks.actions.rhythm import Rhythm as Rhythm
    from farm.tasks.actions.space import ActionSpace as ActionSpace
    from farm.tasks.actions.synergies import Synergies as Synergies
    from farm.tasks.base import Record as Record
    from farm.tasks.base import Score as Score
    from farm.tasks.base import Task as Task
    from farm.tasks.base import TaskConfig as TaskConfig
    from farm.tasks.base import TaskSpec as TaskSpec
    from farm.tasks.robust import Robust as Robust
    from farm.tasks.touch import Touch as Touch
    from farm.tasks.touch import TouchConfig as TouchConfig

_WHERE: Final = {
    "learn": "learner.run.launch",
    "tune": "learner.tools.sweep.tune",
    "sweep": "learner.tools.sweep.sweep",
    "check": "learner.tools.check.check",
    "evaluate": "learner.tools.evaluate.evaluate",
    "export": "learner.tools.export.export",
    "Farm": "learner.farm",
    "Evaluated": "learner.farm",
    "environment": "farm.environments",
    "load": "learner.tools.replay.loaded",
    "rewind": "learner.tools.replay.rewind",
    "RunConfig": "learner.run.config",
    "configure": "learner.run.config",
    "Task": "farm.tasks.base",
    "TaskConfig": "farm.tasks.base",
    "TaskSpec": "farm.tasks.base",
    "ActionSpace": "farm.tasks.actions.space",
    "Offsets": "farm.tasks.actions.offsets",
    "Moves": "farm.tasks.actions.moves",
    "Residual": "farm.tasks.actions.residual",
    "Synergies": "farm.tasks.actions.synergies",
    "Mirrored": "farm.tasks.actions.mirrored",
    "Rhythm": "farm.tasks.actions.rhythm",
    "Clock": "farm.tasks.actions.clock",
    "Channel": "farm.sim.channels",
    "Camera": "farm.sim.channels",
    "Measure": "farm.sim.channels",
    "Quantity": "farm.sim.channels",
    "Touch": "farm.tasks.touch",
    "TouchConfig": "farm.tasks.touch",
    "Robust": "farm.tasks.robust",
    "Record": "farm.tasks.base",
    "Score": "farm.tasks.base",
    "Policy": "farm.policies.base",
    "PolicyConfig": "farm.policies.base",
    "Algorithm": "learner.algorithms",
    "SearchState": "learner.algorithms",
    "Backend": "farm.sim.interfaces",
    "Sim": "farm.sim.sim",
    "Settings": "farm.settings",
    "setting": "farm.settings",
    "FarmError": "farm.errors",
    "ConfigError": "farm.errors",
    "CheckpointError": "farm.errors",
    "RunError": "farm.errors",
    "TaskError": "farm.errors",
}

__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:  # noqa: ANN401  whatever it is
    if name not in _WHERE:
        raise AttributeError(f"module 'farm' has no attribute {name!r}")
    from farm.plugins import load

    return getattr(load(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
