"""Building what a run simulates, from its specification."""

from collections.abc import Mapping
from pathlib import Path

from farm import memory
from farm.net.messages import Spec
from farm.runner import Runner, is_exact, served
from farm.sim import model_files
from farm.sim.interfaces import Backend


def built(
    spec: Spec, files: tuple[Path, ...], contents: Mapping[str, bytes], backend: Backend
) -> Runner:
    """The runner of a run's jobs; arguments and errors as in `farm.runner.served`."""
    runner = Runner(*served(spec, files, contents), backend.engine, exact=is_exact(backend))
    # Building a model with meshes takes more memory than simulating it
    model_files.keep_small()
    memory.give_back()
    return runner
