"""Curves for TensorBoard, in the run's folder: `tensorboard --logdir runs` shows them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class TensorBoard:
    """Event files that TensorBoard shows; needs the extra `tensorboard`."""

    def __init__(self, folder: Path, config: Mapping[str, Any], done: int) -> None:
        """Start a file in the folder `tensorboard`.

        It replaces generations after `done` in older files.
        """
        from tensorboardX import SummaryWriter

        # Their names have seconds alone
        begins = {"purge_step": done + 1, "filename_suffix": f".after{done}"}
        self._writer = SummaryWriter(str(folder / "tensorboard"), **begins)
        self._writer.add_text("config", f"```json\n{json.dumps(config, indent=2)}\n```", done)

    def generation(self, figures: Mapping[str, float]) -> None:
        """Add a point to each curve, over the generations."""
        step = int(figures["generation"])
        for name, value in figures.items():
            if name != "generation":
                self._writer.add_scalar(name, value, step)

    def end(self, summary: Mapping[str, Any]) -> None:
        """Write the summary as a text, and close."""
        if summary:
            text = f"```json\n{json.dumps(summary, indent=2)}\n```"
            self._writer.add_text("summary", text, summary["generations"])
        self._writer.close()
