"""Rerun's viewer in a real browser: `farm view --web`, and the copy of it on the site."""

import functools
import http.server
import importlib.util
import io
import os
import re
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import Browser, need_chromium
from PIL import Image
from processes import Farm

# The browser draws by the processor alone
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def _orange(picture: bytes) -> float:
    """Which part of the left half is of the bar's colour: it is drawn there, and nothing else is
    orange.
    """
    pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(pixels[60:, : pixels.shape[1] // 2], -1, 0)
    return float(((red > 150) & (green > 80) & (green < 0.8 * red) & (blue < 0.4 * red)).mean())


def test_the_page_draws_the_hand(tmp_path: Path) -> None:
    need_chromium()
    farm = Farm(tmp_path)
    try:
        farm.call("run", "--name", "r", "--pairs", "3", "--generations", "4")
        process = farm.start("view", "runs/r", "--web")
        assert process.stdout
        line = process.stdout.readline()
        match = re.fullmatch(
            r"open (http://127\.0\.0\.1:\d+/\?url=\S+)   \(from elsewhere: ssh -L .* first\)\n",
            line,
        )
        assert match, line
        with Browser(tmp_path / "profile") as browser:
            browser.open(match[1])
            farm.wait_for(lambda: _orange(browser.picture()) > 0.005, seconds=300)
            assert browser.errors == [], browser.errors
            if picture := os.environ.get("FARM_PICTURE"):
                Path(picture).write_bytes(browser.picture())
        process.terminate()
        output, _ = process.communicate(timeout=20)
        assert "http" not in output, "one line says where"
    finally:
        farm.close()


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


def test_the_site_has_a_viewer_of_its_own(tmp_path: Path) -> None:
    need_chromium()
    spec = importlib.util.spec_from_file_location(
        "docs_embedded", Path(__file__).parents[2] / "docs/embedded.py"
    )
    assert spec
    assert spec.loader
    embedded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(embedded)
    embedded.on_post_build(SimpleNamespace(site_dir=tmp_path))
    assert b"https://fonts" not in (tmp_path / "viewer/index.html").read_bytes()
    page = tmp_path / "docs/files/index.html"
    page.parent.mkdir(parents=True)
    page.write_text(f"<!doctype html><link rel=icon href=data:,>{embedded.BOX}")
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=tmp_path)
    )
    threading.Thread(target=server.serve_forever).start()
    try:
        with Browser(tmp_path / "profile") as browser:
            browser.open(f"http://127.0.0.1:{server.server_port}/docs/files/")
            browser.call(
                "Runtime.evaluate", expression="document.querySelector('details').open = true"
            )
            farm = Farm(tmp_path)
            farm.wait_for(lambda: _orange(browser.picture()) > 0.005, seconds=300)
            assert browser.errors == [], browser.errors
    finally:
        server.shutdown()
        server.server_close()
