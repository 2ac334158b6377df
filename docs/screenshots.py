"""Pictures of the real Rerun viewer on a run, without a screen.

    python docs/screenshots.py [--out docs/pictures]

Learns short runs, and takes the viewer's pictures of one live, of its file (both tabs), of a
replay, of a comparison, of an environment of Gymnasium and of the fragile bar. Needs a Vulkan
driver (Debian: mesa-vulkan-drivers libvulkan1) and the extras `learner` and `gym`. Exit status 1 if
a view of the viewer reports an error.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import rerun_cli
from PIL import Image
from rerun.experimental import ViewerClient

from farm.net.session import free_endpoint

SIZE: Final = "1600x1000"
_BAR: Final = 37  # [pixels] on top, where the viewer warns of the machine that it runs on
_PATIENCE: Final = 60.0  # [s] for the viewer to start, to load, to draw


class Viewer:
    """A viewer without a window."""

    def __init__(self, client: ViewerClient) -> None:
        """Made by `viewer`."""
        self._client = client
        self.errors: list[str] = []
        """Errors that its views reported."""

    def open(self, source: str) -> None:
        """Show a file or a live stream, and wait until there is something to see."""
        self._client.open([source])
        _until(lambda: self._loaded(), f"nothing is loaded from {source}")

    def show(self, tab: str) -> None:
        """Bring a tab to the front."""
        layout = self._client.get_blueprint("recording").blueprint
        names = {path: _name(part) for path, part in layout.items()}
        for part in layout.values():
            container = part.get("ContainerBlueprint", {})
            for child in container.get("contents", []):
                if (
                    container["container_kind"] == "Tabs"
                    and names.get("/" + child.lstrip("/")) == tab
                ):
                    container["active_tab"] = child
        self._client.set_blueprint(layout, "recording")

    def go(self, timeline: str, **at: float) -> None:
        """Move the cursor to a point of a timeline."""
        self._client.set_time(timeline, play_state="paused", **at)

    def wait(self, generation: int) -> None:
        """Wait until a live stream is there."""
        _until(lambda: self._last() >= generation, f"the run does not reach {generation}")

    def shoot(self, path: Path, *, still: bool = True) -> None:
        """Write the picture: of a still view once two in a row agree, for data comes on demand."""
        last: Any = None
        for _ in range(20 if still else 2):
            time.sleep(1.0)
            last, before = self._client.take_screenshot(), last
            if last == before:
                break
        path.write_bytes(last)
        whole = Image.open(path).convert("RGB")
        # 256 colours, a third of the bytes; without k-means small patches get wrong colours
        whole = whole.crop((0, _BAR, *whole.size))
        few = whole.quantize(kmeans=1, dither=Image.Dither.NONE)
        few.save(path, optimize=True)
        for view in self._client.get_state().views:
            self.errors += [
                f"{path.name}: {view.name}: {r.summary}"
                for r in view.reports
                if r.severity == "error"
            ]

    def _loaded(self) -> bool:
        state = self._client.get_state()
        return (
            not state.loading
            and bool(state.active_recording)
            and any(r.timelines for r in state.recordings)
        )

    def _last(self) -> float:
        """The last generation of what is shown."""
        recordings = self._client.get_state().recordings
        lines = [line for each in recordings for line in each.timelines]
        return max((line.end for line in lines if line.name == "generation"), default=0)


@contextmanager
def viewer() -> Iterator[Viewer]:
    """Start one, and end it."""
    address = free_endpoint().removeprefix("tcp/")
    program = Path(rerun_cli.__file__).with_name("rerun")
    flags = [
        "--bind",
        "127.0.0.1",
        "--port",
        address.rpartition(":")[2],
        "--headless",
        "--hide-welcome-screen",
    ]
    with tempfile.TemporaryDirectory() as home, Path(home, "log").open("w") as log:
        settings = {
            name: home for name in ("HOME", "XDG_RUNTIME_DIR", "XDG_CONFIG_HOME", "XDG_DATA_HOME")
        }
        command = [str(program), *flags, "--window-size", SIZE]
        process = subprocess.Popen(command, env={**os.environ, **settings}, stdout=log, stderr=log)
        try:
            clients: list[ViewerClient] = []
            _until(
                lambda: _connected(address, clients),
                f"the viewer does not start: {Path(home, 'log').read_text()}",
            )
            yield Viewer(clients[0])
        finally:
            process.terminate()
            process.wait()


def main() -> None:
    """Learn, take the pictures, write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "pictures")
    out = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    errors: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        errors += _live(folder, out / "live.png")
        _farm(folder, "run", "--name", "first", "--quiet")
        _farm(folder, "run", "--name", "other", "--seed", "1", "--quiet")
        _farm(folder, "replay", "runs/first")
        _farm(folder, "compare", "runs/first", "runs/other", "--to", "compare.rrd")
        swim = ("--task", "gym:Swimmer-v5", "--steps", "300", "--generations", "15")
        _farm(folder, "run", *swim, "--name", "swim", "--quiet")
        _farm(folder, "run", "--task", "fragile-bar", "--name", "bar", "--quiet")
        for name, source, tab, at in (
            ("viewer", "runs/first/run.rrd", "", ("generation", {"sequence": 90})),
            (
                "rollout",
                "runs/first/run.rrd",
                "Rollout (sim_time)",
                ("sim_time", {"duration": 135.7}),
            ),
            ("replay", "runs/first/rollout.rrd", "", ("sim_time", {"duration": 1.2})),
            ("compare", "compare.rrd", "", None),
            ("fragile", "runs/bar/run.rrd", "Rollout (sim_time)", ("sim_time", {"duration": 51.2})),
            ("gym", "runs/swim/run.rrd", "", ("generation", {"sequence": 15})),
        ):
            with viewer() as window:
                window.open(str(Path(folder, source)))
                if tab:
                    window.show(tab)
                if at:
                    window.go(at[0], **at[1])
                window.shoot(out / f"{name}.png")
            errors += window.errors
    if errors:
        sys.exit("\n".join(errors))


def _live(folder: str, path: Path) -> list[str]:
    """A run while it learns, which is ended then: a viewer warns of a stream that has ended."""
    port = free_endpoint().rpartition(":")[2]
    words = ("run", "--name", "live", "--generations", "1000", "--serve", port)
    command = [sys.executable, "-m", "farm", *words]
    with (
        subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as run,
        viewer() as window,
    ):
        assert run.stdout
        uri = next(match[0] for line in run.stdout if (match := re.search(r"rerun\+http\S+", line)))
        window.open(uri)
        window.wait(40)
        window.shoot(path, still=False)
        run.terminate()
        run.communicate()
    return window.errors


def _farm(folder: str, *words: str) -> None:
    subprocess.run([sys.executable, "-m", "farm", *words], cwd=folder, check=True)


def _connected(address: str, clients: list[ViewerClient]) -> bool:
    try:
        client = ViewerClient.connect(f"rerun+http://{address}/proxy")
        client.get_state()
    except Exception:  # it does not listen yet; the SDK has no narrower name for that
        return False
    clients.append(client)
    return True


def _name(part: dict[str, Any]) -> str | None:
    return (part.get("ContainerBlueprint") or part.get("ViewBlueprint") or {}).get("display_name")


def _until(event: Any, complaint: str) -> None:  # noqa: ANN401
    end = time.monotonic() + _PATIENCE
    while not event():
        if time.monotonic() > end:
            sys.exit(complaint)
        time.sleep(0.1)


if __name__ == "__main__":
    main()
