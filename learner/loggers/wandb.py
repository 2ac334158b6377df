"""Curves for Weights & Biases; configured by its own variables (WANDB_PROJECT,
WANDB_MODE=offline, ...).
"""

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class WeightsAndBiases:
    """A run at Weights & Biases; needs the extra `wandb`, and an account or WANDB_MODE=offline."""

    def __init__(self, folder: Path, config: Mapping[str, Any], done: int) -> None:
        """Start a run with this name, or continue the one that this folder started.

        A run that went back to an earlier generation is another run there, which takes no step
        twice.
        """
        import wandb

        identity, self._last = folder / "wandb" / "id", folder / "wandb" / "last"
        identity.parent.mkdir(exist_ok=True)
        last = int(self._last.read_text("utf-8")) if self._last.exists() else 0
        if not identity.exists() or last > done:
            identity.write_text(secrets.token_hex(8), "utf-8")
        self._run = wandb.init(
            name=folder.resolve().name,
            id=identity.read_text("utf-8"),
            resume="allow",
            dir=str(folder),
            config=dict(config),
            settings=wandb.Settings(console="off", silent=True),
        )

    def generation(self, figures: Mapping[str, float]) -> None:
        """Add a point to each curve, over the generations."""
        self._run.log(dict(figures), step=int(figures["generation"]))
        self._last.write_text(str(int(figures["generation"])), "utf-8")

    def end(self, summary: Mapping[str, Any]) -> None:
        """Store the results, and close."""
        self._run.summary.update(dict(summary))
        self._run.finish(exit_code=int(summary.get("state") == "failed"))
