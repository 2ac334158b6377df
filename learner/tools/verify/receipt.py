"""Receipts of verifications: what was repeated.

An interrupted one is continued if this user's command wrote it.

Whoever sends a run may send a made-up receipt with it. So a receipt carries a seal (HMAC) made with
a secret of this user, a file in the user's own folder, and one with another seal, or none, is
refused.
"""

import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from farm.errors import ConfigError

_SECRET: Final = 32  # [bytes]
_LARGEST: Final = 64 << 20  # [bytes] of a receipt: of ten million generations
_MUST_AGREE: Final = ("chain", "parameters_sha256", "code", "numbers", "all", "release", "verdict")
_DONE: Final = ("chosen", "generations", "rollouts", "workspace")


def sealed(receipt: Mapping[str, Any]) -> dict[str, Any]:
    """A receipt with its seal; without one if this user's secret cannot be kept."""
    bare = {name: value for name, value in receipt.items() if name != "seal"}
    secret = _secret()
    return bare if secret is None else bare | {"seal": _seal(bare, secret)}


def check_replaced(path: Path) -> None:
    """Check that what is at a receipt's place is nothing, or an earlier receipt.

    Raises:
      ConfigError: it is another file.
    """
    if not path.exists():
        return
    try:
        old = json.loads(path.read_text("utf-8")) if path.stat().st_size <= _LARGEST else None
    except (OSError, ValueError, RecursionError):
        old = None
    if not isinstance(old, dict) or "verdict" not in old:
        raise ConfigError(f"--receipt {path} exists and is no receipt: take another name")


def continued(path: Path, receipt: Mapping[str, Any]) -> dict[str, Any] | None:
    """What an interrupted verification of the same run by this user has done; None if there is
    none.

    Raises:
      ConfigError: there is a receipt of an interrupted verification that this user did not write.
    """
    try:
        old = json.loads(path.read_text("utf-8")) if path.stat().st_size <= _LARGEST else None
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(old, dict) or old.get("verdict") != "interrupted":
        return None
    seal, secret = str(old.pop("seal", "")), _secret()
    if secret is None or not hmac.compare_digest(seal.encode(), _seal(old, secret).encode()):
        raise ConfigError(
            f"{path} says that a verification was interrupted, but was not written by you on this"
            " machine: remove it, or take another --receipt"
        )
    same = all(old.get(name) == receipt[name] for name in _MUST_AGREE)
    return {name: old[name] for name in _DONE} if same else None


def digest_of(checkpoint: Path) -> str:
    """SHA-256 of a checkpoint, which a continued repetition must have; empty if there is none."""
    return hashlib.sha256(checkpoint.read_bytes()).hexdigest() if checkpoint.is_file() else ""


def _seal(receipt: Mapping[str, Any], secret: bytes) -> str:
    return hmac.new(secret, json.dumps(receipt, sort_keys=True).encode(), "sha256").hexdigest()


def _secret() -> bytes | None:
    """Secret of this user, made when it is first needed; None if it cannot be kept."""
    folder = (
        Path(os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser())
        / "rolloutfarm"
    )
    path = folder / "receipts.key"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            os.write(file, secrets.token_bytes(_SECRET))
            os.close(file)
        content = path.read_bytes()
    except (OSError, RuntimeError):
        return None
    return content if len(content) == _SECRET else None
