"""The state needed to resume a run, in one file that is replaced atomically."""

import hashlib
import logging
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray, array
from farm.errors import CheckpointError, MessageError
from farm.net import codec
from farm.net.codec import keyed
from farm.net.messages import check_assets
from farm.replacing import replacing
from learner.run.shrinking import Shrinking

log = logging.getLogger(__name__)

_MAGIC: Final = b"rolloutfarm checkpoint 2\n"
_MOST_GENERATIONS: Final = 10_000_000
_DIGEST: Final = hashlib.sha256().digest_size
SCHEMA: Final = 2
"""Version of what follows, whichever one messages have."""


@dataclass(frozen=True, kw_only=True)
class BestRollout:
    """A rollout that can be repeated."""

    seed: tuple[int, ...] | None
    """Seed of the rollout; None for nominal conditions."""
    theta: FloatArray = array("<f8", 1)
    """Parameters of the rollout, (P,)"""
    normaliser: FloatArray = array("<f8", 2, np.empty((2, 0)))
    """Mean and standard deviation that its observations were normalised by, (2, d) or (2, 0)"""


@dataclass(frozen=True, kw_only=True)
class Validated:
    """A mean policy with its score from the starts of validation."""

    score: float
    """Score, by `learner.run.evaluation.score`."""
    generation: int
    """Number of updates before it."""
    mu: FloatArray = array("<f8", 1)
    """The search's mean, (P,)"""
    normaliser: FloatArray = array("<f8", 2, np.empty((2, 0)))
    """Mean and standard deviation that its observations are normalised by, (2, d) or (2, 0)"""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """State of a run between two generations."""

    run: str
    config: dict[str, Any]
    """Contents of config.json."""
    state: dict[str, Any]
    """The algorithm's state, from its `to_dict`."""
    rollouts: int
    """Exploring rollouts so far."""
    reissued: int
    """Jobs reissued so far."""
    seconds: float
    """Wall time so far [s]."""
    solved: int
    """Successive generations in which the mean policy succeeded."""
    best: BestRollout | None
    best_generation: int
    fingerprint: str = keyed("canary")
    """Fingerprint of the machines whose numbers the run accepts, or how it begins."""
    replayed: bool
    """Whether the best rollout has been recorded at physics rate."""
    code: dict[str, str]
    """Digests of the code that determines its numbers."""
    files: dict[str, str]
    """Texts of its task by path."""
    constants: dict[str, Any]
    """Constant arrays of its policy by name."""
    assets: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the other files of its task by path; the folder has their contents."""
    steps: int = 0
    """Control steps of all exploring rollouts so far."""
    pairs: int = 0
    """Pairs of the next generation; 0: the number in the algorithm's settings."""
    expelled: dict[str, str] = field(default_factory=dict)
    """Hosts that returned wrong numbers, and the reasons."""
    checks: dict[str, int] = field(default_factory=dict)
    """Number of checks that each host has passed."""
    first: dict[str, int] = field(default_factory=dict)
    """Finished generations when each host answered for the first time."""
    chain: str = ""
    """Digest of the last generation in the run's chain, or of its settings."""
    undone: int = 0
    """Generations that were repeated because a host in them was expelled."""
    moments: FloatArray = array("<f8", 1, np.empty(0))
    """Moments of the observations of all exploring rollouts, as in `farm.moments`: (1 + 2 d,), or
    (0,) if none are kept
    """
    validated: Validated | None = None
    """The best of the mean policies that generations validated, of equal ones the first; None if
    there is none.
    """
    shrinking: Shrinking = Shrinking()
    """What validations say of the search's steps."""
    last_score: float | None = None
    """Score of the last policy, from the same starts; None until the end of the run."""

    @property
    def better(self) -> Validated | None:
        """The validated policy, if the last one is not better than it; None: the last one is the
        run's policy.

        Of a run that has not ended, the policy before learning is none of it.
        """
        best, last = self.validated, self.last_score
        if best is None or (last is None and best.generation == 0):
            return None
        return None if last is not None and last > best.score else best


def save(path: Path, checkpoint: Checkpoint, *, durable: bool = False) -> None:
    """Replace the file by a new one, or leave the old one as it is.

    A killed process loses nothing. A power failure may truncate the file; `durable` keeps a copy
    that survives it, `FILE.safe`, but waits for the disk, which takes longer than a short
    generation.
    """
    body = codec.encode(checkpoint, SCHEMA)
    content = _MAGIC + hashlib.sha256(body).digest() + body
    if durable:
        replace(_safe(path), content, sync=True)
    replace(path, content)


def settle(path: Path) -> None:
    """Flush the file itself to the disk, and delete the copy."""
    flush(path)
    _safe(path).unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Wait until a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _safe(path: Path) -> Path:
    return path.with_name(path.name + ".safe")


def replace(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a whole file, or (an OSError) leave the old one."""
    with replacing(path) as aside:
        aside.write_bytes(content)
        if sync:
            flush(aside)


def load(path: Path) -> Checkpoint:
    """Read the checkpoint in a file, or in its copy if the file is damaged.

    Raises:
      CheckpointError: there is none, or it is truncated or of another version.
    """
    try:
        return _read(path)
    except CheckpointError as error:
        try:
            copy = _read(_safe(path))
        except CheckpointError:
            raise error from None
        log.warning("%s is missing or damaged; continuing from its copy %s", path, _safe(path).name)
        return copy


def _read(path: Path) -> Checkpoint:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(
            f"no checkpoint at {path} ({error.strerror}): is this a run's folder?"
        ) from None
    body = content[len(_MAGIC) + _DIGEST :]
    if not content.startswith(_MAGIC[:-3]):
        raise CheckpointError(f"{path} is not a checkpoint, or its beginning is damaged")
    if not content.startswith(_MAGIC):
        raise CheckpointError(
            f"{path} is a checkpoint of another version; use the release that wrote it"
        )
    if hashlib.sha256(body).digest() != content[len(_MAGIC) : len(_MAGIC) + _DIGEST]:
        raise CheckpointError(f"{path} is truncated or damaged; it cannot be read")
    try:
        checkpoint = codec.decode(body, Checkpoint, SCHEMA, most=len(body))
        check_assets(checkpoint.assets)
    except (MessageError, ValueError) as error:
        raise CheckpointError(f"{path}: {error}") from None
    wrong = _wrong(checkpoint.state)
    if not all(isinstance(values, np.ndarray) for values in checkpoint.constants.values()):
        wrong = "a constant of its policy is no array"
    if wrong:
        raise CheckpointError(f"{path}: {wrong}")
    return checkpoint


def _wrong(state: dict[str, Any]) -> str:
    """Say what is wrong with the values that every algorithm's state has; nothing if they are
    possible.
    """
    generation = state.get("generation")
    if type(generation) is not int or not 0 <= generation <= _MOST_GENERATIONS:
        return f"its generation is {str(generation)[:40]!r}; expected 0 to {_MOST_GENERATIONS}"
    sizes = set()
    for name in ("mu", "sigma"):
        values = state.get(name)
        if (
            not isinstance(values, np.ndarray)
            or values.ndim != 1
            or values.dtype != np.dtype("<f8")
            or not values.size
        ):
            return f"its {name} is no vector of numbers"
        if not np.isfinite(values).all():
            return f"its {name} is not finite"
        sizes.add(values.size)
    return "" if len(sizes) == 1 else "its mu and sigma have different lengths"
