"""Rerun's viewer on the site, with a rollout of the published gait.

The viewer's files are those that the installed release serves to a browser: nothing is loaded from
elsewhere.
"""

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.request import urlopen

ROOT = Path(__file__).parent.parent
PAGE, PICTURE = "docs/files.md", "![The viewer on a finished run](pictures/viewer.png)\n"
FILES = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "apple-touch-icon.png")
FONTS = re.compile(rb"<link[^>]*https://fonts\.[^>]*>")
BOX = """
<details ontoggle="const at = new window.URL('../../viewer/', location), frame = this.querySelector('iframe');
frame.src ||= `${at}?url=${encodeURIComponent(at + 'gait.rrd')}`">
<summary>The viewer itself, with a rollout of a learnt gait (44 MB)</summary>
<iframe title="Rerun's viewer" style="width: 100%; height: 40rem; border: 0"></iframe>
</details>
"""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:  # noqa: ANN401  of mkdocs
    """The page about recordings, with a box that opens the viewer."""
    if page.file.src_uri != PAGE:
        return markdown
    if PICTURE not in markdown:
        raise ValueError(f"{PAGE} has no line {PICTURE!r}")
    return markdown.replace(PICTURE, PICTURE + BOX)


def on_post_build(config: Any) -> None:  # noqa: ANN401  of mkdocs
    """Write the viewer and the recording."""
    from learner.recording.files import program, quiet
    from learner.recording.viewing import free_port, listens

    folder = Path(config.site_dir) / "viewer"
    folder.mkdir(exist_ok=True)
    recording = folder / "gait.rrd"
    recording.unlink(missing_ok=True)
    words = ["replay", str(ROOT / "docs/results/runs/gait"), "--to", str(recording)]
    done = subprocess.run(
        [sys.executable, "-m", "farm", *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"farm {' '.join(words)}: {done.stderr}")
    port, page = free_port(), free_port()
    command = [program(), str(recording), "--serve-web", "--bind", "127.0.0.1", "--port", str(port)]
    command += ["--web-viewer-port", str(page)]
    with (
        TemporaryDirectory() as home,
        subprocess.Popen(command, env=quiet(Path(home)), stdout=subprocess.DEVNULL) as viewer,
    ):
        try:
            if not listens(page, lambda: viewer.poll() is not None):
                raise RuntimeError("Rerun's viewer does not start")
            for name in FILES:
                with urlopen(f"http://127.0.0.1:{page}/{name}") as answer:
                    got = answer.read()
                (folder / name).write_bytes(FONTS.sub(b"", got) if name == "index.html" else got)
        finally:
            viewer.terminate()
