"""The figure of a stress test."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from learner.plots import COLOURS, DASHES, canvas

_BLACK: Final = "#000000"
_CAUSES: Final = tuple(colour for colour in COLOURS if colour != _BLACK)


def draw(
    strengths: Sequence[float],
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    word: str,
    path: Path,
) -> None:
    """Draw what a policy does over the strength of each cause, the last of which is all together;
    an SVG file.

    Args:
      strengths: S of them.
      curves: by cause the share (S,), which is empty without a `word`, and the mean return (S,).
      word: what the share is of.
      path: of the file.

    Raises:
      OSError: it cannot be written.
    """
    panels = (0, 1) if word else (1,)
    with canvas(path, 7.0, 3.4) as figure:
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axis, at in zip(axes, panels, strict=True):
            for i, (cause, values) in enumerate(curves.items()):
                last = i + 1 == len(curves)
                colour = _BLACK if last else _CAUSES[i % len(_CAUSES)]
                dash = DASHES[0 if last else i // len(_CAUSES) % len(DASHES)]
                width = 2.4 if last else 1.3
                axis.plot(
                    strengths, values[at], color=colour, linestyle=dash, lw=width, label=cause
                )
            axis.set(xlabel="times its range", ylabel=word if at == 0 else "mean return")
            if at == 0:
                axis.set_ylim(-0.03, 1.03)
        figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside right upper")
