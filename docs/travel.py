"""Films a task that the learner sends: edited on one machine, learnt at once by workers on two
other machines.

    sudo python docs/travel.py [--out docs/pictures/travel.gif]

The three hosts are network namespaces. The text after a command is what the program printed, at the
time when it did. The commands are shown with shorter paths and with the host's name. Needs root,
iproute2, and the extras `certificates`, `figures` and `video`.
"""

import argparse
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "e2e"))
from network import Network, address

REWARD: Final = ("np.cos(sim.qpos[:, 0])", "-np.cos(sim.qpos[:, 0])")
"""Of the template: upright; and after the edit: hanging."""
PANES: Final = {
    "laptop": (0, 0, 680, 420),
    "left": (680, 0, 540, 210),
    "right": (680, 210, 540, 210),
}
"""Left, top, width, height [pixels]."""
RATE: Final = 8  # frames per second
_FONT: Final = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSansMono.ttf"
_SHADES: Final = {"$": "#ffffff", "#": "#8fbf8f", " ": "#c8ccd4"}


class Line(NamedTuple):
    """Something on a screen."""

    at: float
    """[s]"""
    pane: str
    text: str


class Stage:
    """Processes on hosts, and what they print when."""

    def __init__(self, folder: Path, network: Network) -> None:
        self.folder = folder
        self.lines: list[Line] = []
        self.begun = time.monotonic()
        self._hosts = dict(zip(PANES, network.hosts, strict=True))
        self._open: list[subprocess.Popen[str]] = []

    def say(self, pane: str, text: str) -> None:
        """Put a line on a screen."""
        self.lines.append(Line(time.monotonic() - self.begun, pane, text))

    def start(self, pane: str, *words: str, caption: str = "") -> "subprocess.Popen[str]":
        """Start a command on a host; `caption` is how it is typed, nothing where it is not seen."""
        if caption:
            self.say(pane, f"$ {caption}")
        command = [
            "ip",
            "netns",
            "exec",
            self._hosts[pane],
            sys.executable,
            "-P",
            "-m",
            "farm",
            *words,
        ]
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._open.append(process)
        if caption:
            threading.Thread(target=self._listen, args=(pane, process), daemon=True).start()
        return process

    def _listen(self, pane: str, process: "subprocess.Popen[str]") -> None:
        for line in process.stdout or ():
            self.say(pane, line.rstrip())

    def until(self, pane: str, words: str) -> None:
        """Wait for a line."""
        deadline = time.monotonic() + 60.0
        while not any(line.pane == pane and words in line.text for line in list(self.lines)):
            if time.monotonic() > deadline:
                raise SystemExit(
                    f"{pane} never said {words!r}: {[line.text for line in self.lines]}"
                )
            time.sleep(0.02)

    def close(self) -> None:
        """End all processes."""
        for process in reversed(self._open):
            process.terminate()
            process.wait(20)


def main() -> None:
    """Play it, and film it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "pictures" / "travel.gif"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, closing(Network(len(PANES))) as network:
        lines = play(Stage(Path(folder), network))
    frames = list(film(lines))
    first, *rest = (frame.quantize(16, dither=Image.Dither.NONE) for frame in frames)
    first.save(
        arguments.out,
        save_all=True,
        append_images=rest,
        duration=1000 // RATE,
        loop=0,
        optimize=True,
    )
    sys.stdout.write(
        f"{arguments.out}: {len(frames)} frames, {arguments.out.stat().st_size // 1000} kB\n"
    )


def play(stage: Stage) -> list[Line]:
    """The scenes."""
    names = [word for name in ("left", "right") for word in ("--worker", name)]
    stage.start("laptop", "certificates", "new", "certs", "--learner", address(0), *names).wait(60)
    stage.start("laptop", "new-task", "pole").wait(60)
    join = ("--connect", f"tls/{address(0)}:7447", "--tls")
    router = stage.start("laptop", "router", "--listen", join[1], "--tls", "certs/learner")
    try:
        next(iter(router.stdout or ()))
        stage.lines.clear()
        stage.begun = time.monotonic()
        for name in ("left", "right"):
            words = ("worker", *join, f"certs/worker-{name}", "--workers", "1", "--accept-code")
            stage.start(
                name,
                *words,
                caption=(
                    f"farm worker --connect tls/laptop:7447 --tls worker-{name} --workers 1"
                    " --accept-code"
                ),
            )
        for name in ("left", "right"):
            stage.until(name, "joined as")
        source = stage.folder / "pole.py"
        for run, (old, new) in (("first", ("", "")), ("second", REWARD)):
            text = source.read_text().replace(old, new, 1) if old else source.read_text()
            source.write_text(text)
            (reward,) = [
                line.strip()
                for line in text.splitlines()
                if line.endswith("np.cos(sim.qpos[:, 0])")
            ]
            stage.say(
                "laptop",
                f"# pole.py, {'edited and saved' if old else 'as new-task wrote it'}:  {reward}",
            )
            words = ("learner", *join, "certs/learner", "--task", "pole.py:Pole", "--name", run)
            flags = ("--generations", "8", "--pairs", "20", "--no-record")
            caption = (
                "farm learner --connect tls/laptop:7447 --tls learner --task pole.py:Pole --name"
                f" {run} "
            )
            caption += " ".join(flags)
            process = stage.start("laptop", *words, *flags, caption=caption)
            process.wait(60)
            stage.until("laptop", "hash")
            time.sleep(0.5)
            for name in ("left", "right"):
                stage.until(name, f"serving run {run}")
        return list(stage.lines)
    finally:
        stage.close()


def film(lines: list[Line]) -> list[Image.Image]:
    """A frame every 1 / RATE s, and two seconds of the last one."""
    font = ImageFont.truetype(str(_FONT), 11)
    end = max(line.at for line in lines)
    return [_frame(lines, i / RATE, font) for i in range(int(end * RATE) + 2)] + [
        _frame(lines, end + 1, font)
    ] * (2 * RATE)


def _frame(lines: list[Line], now: float, font: ImageFont.FreeTypeFont) -> Image.Image:
    width = max(x + w for x, _, w, _ in PANES.values())
    height = max(y + h for _, y, _, h in PANES.values())
    picture = Image.new("RGB", (width, height), "#15181d")
    pen = ImageDraw.Draw(picture)
    for pane, (x, y, w, h) in PANES.items():
        pen.rectangle((x, y, x + w - 1, y + h - 1), outline="#3c434d")
        pen.rectangle((x, y, x + w - 1, y + 18), fill="#3c434d")
        pen.text((x + 8, y + 3), pane, fill="#ffffff", font=font)
        columns, rows = (w - 16) // 7, (h - 30) // 15
        texts = [
            (text, _SHADES.get(line.text[:1], _SHADES[" "]))
            for line in lines
            if line.pane == pane and line.at <= now
            for text in textwrap.wrap(line.text, columns, subsequent_indent="    ") or [""]
        ]
        for row, (text, shade) in enumerate(texts[-rows:]):
            pen.text((x + 8, y + 24 + 15 * row), text, fill=shade, font=font)
    return picture


if __name__ == "__main__":
    main()
