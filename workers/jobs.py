"""What a run's specification and a job mean: the task, the controller, its parameters. Pure."""

from typing import Any

import numpy as np

from farm import tasks
from farm.arrays import FloatArray
from farm.errors import ConfigError, UnservedError
from farm.net.jobs import Job
from farm.net.messages import Spec
from farm.policies.fourier import Features, Policy, PolicyConfig
from farm.tasks.finger_gait.task import TaskConfig


def specified(spec: Spec) -> tuple[TaskConfig, Policy]:
    """The task and the controller of a run.

    Raises:
      UnservedError: it names something this release does not know, or this machine does not have.
    """
    try:
        settings: dict[str, Any] = {**spec.task_config, "task": spec.task}
        config = TaskConfig(**settings)
        controller = PolicyConfig(**spec.policy_config)
        sizes = tasks.sizes(config)
    except (TypeError, ValueError) as error:
        raise UnservedError(f"a specification that this release does not understand: {error}") from None
    except ConfigError as error:
        raise UnservedError(str(error)) from None
    if sizes.release != spec.release:
        raise UnservedError(f"the run has {spec.task} of gymnasium {spec.release}, here is {sizes.release}")
    if spec.frequencies.shape != (len(spec.phases), sizes.observation):
        raise UnservedError(f"features of shape {spec.frequencies.shape} for {sizes.observation} state components")
    features = Features(frequencies=spec.frequencies, phases=spec.phases)
    return config, Policy(controller, sizes.observation, features, (sizes.lower, sizes.upper))


def parameters(mu: FloatArray, job: Job) -> list[FloatArray]:
    """The parameter vectors (P,) of a job's rollouts, one a sign."""
    origin = mu if job.origin == "mu" else np.zeros_like(mu)
    return [origin + sign * job.eps if job.eps.size else origin for sign in job.signs]
