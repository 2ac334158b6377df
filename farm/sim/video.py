"""Writes pictures to a video file: gif by pillow, mp4 by imageio-ffmpeg.

The only module that imports these.
"""

import importlib.util
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.sim import paint
from farm.sim.channels import Channel
from farm.sim.rendering import Picture, check_drawing

if TYPE_CHECKING:
    from PIL import Image

FRAMES: Final = 30
"""Approximate pictures per second: a gif counts time in hundredths of a second."""

SIZE: Final = (480, 360)
"""Width and height [pixels]."""

_PILLOW: Final = ("PIL", "pillow")  # also for captions
_NEEDS: Final = {".gif": (_PILLOW,), ".mp4": (("imageio_ffmpeg", "imageio-ffmpeg"), _PILLOW)}
_INK: Final = (40, 44, 52)
_PAPER: Final = (250, 250, 250)
_LETTERS: Final = (17, 9)  # height of a caption's letters, and the least [pixels]
_EDGE: Final = 6  # around a caption [pixels]
_BAR: Final = (90, 9)  # width and height of a full bar [pixels]
_LINE: Final = 16  # height of a bar's line [pixels]
_SMALL: Final = 12  # height of its letters [pixels]
_GROOVE: Final = (214, 216, 219)
_COLOURS: Final = 256  # of a gif
_UNFINISHED: Final = "ffmpeg has not finished it; is there room on the disk?"


def check(path: Path) -> None:
    """Check that a video can be drawn and written there, before what it shows is simulated.

    Raises:
      ConfigError: its suffix, package or folder is wrong.
      RunError: MuJoCo cannot draw on this machine.
    """
    if path.suffix not in _NEEDS:
        raise ConfigError(f"--video {path}: expected a name that ends in {' or '.join(_NEEDS)}")
    for package, name in _NEEDS[path.suffix]:
        if importlib.util.find_spec(package) is None:
            raise ConfigError(f"a {path.suffix} needs {name}: pip install {name}")
    if path.is_dir():
        raise ConfigError(f"--video {path}: it is a folder; give another name")
    if not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: there is no folder {path.parent}")
    check_drawing()


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


def captioned(pictures: Iterable[Picture], text: str) -> Iterator[Picture]:
    """Pictures with a text in the lower left corner, in letters that are smaller where a line would
    be too wide; as they are if it is empty.
    """
    from PIL import Image, ImageDraw, ImageFont

    stamp: Image.Image | None = None
    for picture in pictures:
        if not text:
            yield picture
            continue
        if stamp is None:
            room = picture.shape[1] - 2 * _EDGE
            pen = ImageDraw.Draw(Image.new("RGB", (1, 1)))
            for letters in range(_LETTERS[0], _LETTERS[1] - 1, -1):
                font = ImageFont.load_default(letters)
                right, bottom = pen.textbbox((0, 0), text, font)[2:]
                if right <= room:
                    break
            size = (round(right) + 2 * _EDGE, round(bottom) + 2 * _EDGE)
            stamp = Image.new("RGB", size, _PAPER)
            ImageDraw.Draw(stamp).text((_EDGE, _EDGE), text, _INK, font)
        image = Image.fromarray(picture)
        image.paste(stamp, (0, picture.shape[0] - stamp.height))
        yield np.asarray(image)


def barred(
    pictures: Iterable[Picture], channels: Sequence[Channel], values: Mapping[str, FloatArray]
) -> Iterator[Picture]:
    """Pictures with a bar, in the upper left corner, for each scalar of the channels that are shown
    as bars; as they are without such channels.

    Args:
      pictures: F of them.
      channels: of a task.
      values: of these channels by name, (F, ...).
    """
    of_bars = [each for each in channels if each.bars]
    for frame, picture in enumerate(pictures):
        rows = [
            (channel, i, float(values[channel.name][frame, i]))
            for channel in of_bars
            for i in range(channel.shape[0])
        ]
        yield _with_bars(picture, rows) if rows else picture


def _with_bars(picture: Picture, rows: Sequence[tuple[Channel, int, float]]) -> Picture:
    """A picture with a line for each (channel, index, value): its name, its bar, the value."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(_SMALL)
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    begin = 2 * _EDGE + max(round(pen.textlength(each.names[i], font)) for each, i, _ in rows)
    for line, (channel, i, value) in enumerate(rows):
        low, high = channel.limits.get(channel.names[i], (0.0, channel.top))
        colours = channel.colours or paint.PALETTE
        top = _EDGE + line * _LINE
        bottom = top + _BAR[1]

        def at(number: float, low: float = low, high: float = high) -> int:
            return begin + round(_BAR[0] * min(max((number - low) / (high - low), 0.0), 1.0))

        pen.rectangle((begin, top, begin + _BAR[0], bottom), _GROOVE)
        if math.isfinite(value):  # it is not in a rollout whose physics blew up
            ends = sorted((at(0.0), at(value)))
            pen.rectangle((ends[0], top, ends[1], bottom), tuple(colours[i % len(colours)]))
        middle = (top + bottom) / 2
        pen.text((_EDGE, middle), channel.names[i], _INK, font, anchor="lm")
        text = f"{value:.2f} {channel.unit}".rstrip()
        pen.text((begin + _BAR[0] + _EDGE, middle), text, _INK, font, anchor="lm")
    return np.asarray(image)


def write(path: Path, pictures: Iterable[Picture]) -> None:
    """Write a video; the suffix chooses its kind. An existing file is replaced.

    Raises:
      OSError: the file cannot be written, or not to its end.
    """
    (_gif if path.suffix == ".gif" else _mp4)(path, pictures)


def palette(images: "Sequence[Image.Image]", colours: int) -> "Image.Image":
    """An image with one palette of this even number of colours for all images of a film: colours do
    not flicker, and parts that do not change take no space.
    """
    from PIL import Image

    samples = images[:: max(1, len(images) // 8)]
    sheet = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for i, image in enumerate(samples):
        sheet.paste(image, (0, i * image.height))
    # Half of it are frequent colours; the other half covers rare ones, such as a painted
    # geometry's.
    half = colours // 2
    ways = (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE)
    halves = [(sheet.quantize(half, way).getpalette() or [])[: 3 * half] for way in ways]
    common = Image.new("P", (1, 1))
    common.putpalette(halves[0] + halves[1])
    return common


def _gif(path: Path, pictures: Iterable[Picture]) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    common = palette(images, _COLOURS)
    first, *rest = [image.quantize(palette=common, dither=Image.Dither.NONE) for image in images]
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=round(100 / FRAMES) * 10,
        loop=0,
        optimize=True,
    )


def _mp4(path: Path, pictures: Iterable[Picture]) -> None:
    """Write pictures as they come: the film of a long rollout is larger than memory."""
    import imageio_ffmpeg

    path.touch()  # fails with an errno; ffmpeg's own message is a page long
    others = iter(pictures)
    first = next(others)
    height, width, _ = first.shape
    out = imageio_ffmpeg.write_frames(
        path,
        (width, height),
        fps=FRAMES,
        quality=8,
        macro_block_size=8,
        ffmpeg_log_level="quiet",
    )
    out.send(None)
    number = 0
    for picture in itertools.chain([first], others):
        try:
            out.send(np.ascontiguousarray(picture))
        except OSError:
            raise OSError(_UNFINISHED) from None
        number += 1
    out.close()
    # ffmpeg's exit status is not told: whether it has written all of it, the file says
    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(path)
    except RuntimeError:
        written = 0
    if written != number:
        raise OSError(_UNFINISHED)
