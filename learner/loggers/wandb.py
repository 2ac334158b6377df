"""Curves for Weights & Biases; configured by its own variables (WANDB_PROJECT, WANDB_MODE=offline, ...)."""

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class WeightsAndBiases:
    """A run at Weights & Biases; needs the extra `wandb`, and an account or WANDB_MODE=offline."""

    def __init__(self, folder: Path, config: Mapping[str, Any], done: int) -> None:  # noqa: ARG002  steps say it
        """Start a run with this name, or continue the one that this folder started."""
        import wandb

        known = folder / "wandb" / "id"
        known.parent.mkdir(exist_ok=True)
        if not known.exists():
            known.write_text(secrets.token_hex(8), "utf-8")
        self._run = wandb.init(
            name=folder.resolve().name, id=known.read_text("utf-8"), resume="allow", dir=str(folder),
            config=dict(config), settings=wandb.Settings(console="off", silent=True),
        )  # fmt: skip

    def generation(self, figures: Mapping[str, float]) -> None:
        """Add a point to each curve, over the generations."""
        self._run.log(dict(figures), step=int(figures["generation"]))

    def end(self, summary: Mapping[str, Any]) -> None:
        """Store the results, and close."""
        self._run.summary.update(dict(summary))
        self._run.finish(exit_code=int(summary.get("state") == "failed"))
