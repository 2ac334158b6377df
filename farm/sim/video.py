"""Writes pictures to a video file: gif by pillow, mp4 by imageio-ffmpeg.

The only module that imports these.
"""

import importlib.util
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from farm.errors import ConfigError, writing
from farm.sim.rendering import Picture

FRAMES: Final = 30
"""Approximate pictures per second: a gif counts time in hundredths of a second."""

SIZE: Final = (480, 360)
"""Width and height [pixels]."""

_NEEDS: Final = {".gif": ("PIL", "pillow"), ".mp4": ("imageio_ffmpeg", "imageio-ffmpeg")}
_COLOURS: Final = 256  # of a gif


def check(path: Path) -> None:
    """Check suffix, package and folder of a video; raises ConfigError if it cannot be written."""
    if path.suffix not in _NEEDS:
        raise ConfigError(f"--video {path}: expected a name that ends in {' or '.join(_NEEDS)}")
    package, name = _NEEDS[path.suffix]
    if importlib.util.find_spec(package) is None:
        raise ConfigError(f"a {path.suffix} needs {name}: pip install {name}")
    if not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: there is no folder {path.parent}")


def moments(times: Sequence[float], speed: float, rest: float) -> list[int]:
    """Which frame of a rollout each picture of its video shows.

    Args:
      times: of the frames [s], rising, evenly spaced.
      speed: seconds of the rollout per second of the video.
      rest: how long the last frame stays [s].
    """
    span = times[-1] - times[0]
    count = max(1, round(span / speed * FRAMES))
    indices = np.linspace(0, len(times) - 1, count + 1).round().astype(int).tolist()
    return [*indices, *[len(times) - 1] * round(rest * FRAMES)]


def tiled(pictures: Sequence[Picture]) -> Picture:
    """Pictures of one size in a grid, row by row, as wide as high or one wider; unused cells are
    white.
    """
    wide = math.ceil(math.sqrt(len(pictures)))
    white = [np.full_like(pictures[0], 255)] * (-len(pictures) % wide)
    cells = [*pictures, *white]
    rows = [np.concatenate(cells[i : i + wide], axis=1) for i in range(0, len(cells), wide)]
    return np.concatenate(rows)


def write(path: Path, pictures: Iterable[Picture]) -> None:
    """Write a video; the suffix chooses its kind. An existing file is replaced.

    Raises:
      RunError: the file cannot be written.
    """
    with writing(path):
        (_gif if path.suffix == ".gif" else _mp4)(path, list(pictures))


def _gif(path: Path, pictures: list[Picture]) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    # One palette for all pictures: colours do not flicker, and parts that do not change take no
    # space.
    samples = images[:: max(1, len(images) // 8)]
    sheet = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for i, image in enumerate(samples):
        sheet.paste(image, (0, i * image.height))
    # Half of it are frequent colours; the other half covers rare ones, such as a painted
    # geometry's.
    ways = (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE)
    halves = [
        (sheet.quantize(_COLOURS // 2, way).getpalette() or [])[: 3 * (_COLOURS // 2)]
        for way in ways
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette(halves[0] + halves[1])
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=round(100 / FRAMES) * 10,
        loop=0,
        optimize=True,
    )


def _mp4(path: Path, pictures: list[Picture]) -> None:
    import imageio_ffmpeg

    height, width, _ = pictures[0].shape
    path.touch()  # fails with an errno; ffmpeg's own message is a page long
    out = imageio_ffmpeg.write_frames(
        path, (width, height), fps=FRAMES, quality=8, macro_block_size=8
    )
    out.send(None)
    for picture in pictures:
        out.send(np.ascontiguousarray(picture))
    out.close()
