"""A learnt policy as a file, from Python; what `farm export` does.

import farm

farm.export("runs/first", "policy.npz")
"""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from farm.errors import ConfigError
from learner.run.folder import opened
from learner.tools.export import npz, onnx
from learner.tools.replay.loaded import LoadedPolicy, loaded


def export(
    run: str | Path,
    to: str | Path,
    *,
    generation: int | None = None,
    last: bool = False,
    allow_file: str | Path | Sequence[str | Path] | None = None,
) -> LoadedPolicy:
    """Write a run's policy to a file, of which docs/export.md says what is in it.

    Args:
      run: its folder.
      to: the file, replaced if it exists: .npz (with the task, for MuJoCo and numpy) or .onnx (the
          policy alone).
      generation: whose mean policy is written (0: before learning), instead of the run's own.
      last: take the policy after the last generation, though a validated one is better.
      allow_file: files with classes of a run that somebody else made.

    Returns:
      The policy that was written.

    Raises:
      ConfigError: there is no such run or generation, the file's name ends otherwise, or the policy
          has no such form.
      RunError: the file cannot be written.

    Example:
      ```python
      import numpy as np

      import farm

      policy = farm.export("runs/first", "policy.npz")
      with np.load("policy.npz") as file:
          assert (file["mu"] == policy.mu).all()
      ```
    """
    writer = form(Path(to))
    policy = loaded(opened(run, allow_file), generation, last=last)
    writer.write(Path(to), policy)
    return policy


def form(to: Path) -> ModuleType:
    """The module that writes such a file; a ConfigError if none does."""
    if to.suffix not in (".npz", ".onnx"):
        raise ConfigError(f"{to}: expected a name that ends in .npz or .onnx")
    return onnx if to.suffix == ".onnx" else npz
