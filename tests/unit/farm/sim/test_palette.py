"""The colours of a film: also of what is seen in a few of its pictures only."""

import numpy as np
import pytest

from farm.sim.video import palette

Image = pytest.importorskip("PIL.Image")

GREEN = (0, 158, 115)


def test_what_is_small_and_hidden_later_keeps_its_colour() -> None:
    rng = np.random.default_rng(0)
    grey = rng.integers(120, 255, (60, 80, 1), np.uint8).repeat(3, axis=2)  # a lit floor
    first = grey.copy()
    first[20:24, 30:36] = GREEN
    images = [Image.fromarray(first), *[Image.fromarray(grey)] * 20]
    common = palette(images, 64)
    drawn = images[0].quantize(palette=common, dither=Image.Dither.NONE).convert("RGB")
    shown = np.array(drawn.getpixel((32, 22)), float)
    assert np.abs(shown - GREEN).max() <= 8
