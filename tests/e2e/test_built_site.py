"""The built site: its pages have all files that they name, and a real browser shows them as they
are meant.

FARM_SITE is the folder of a built site; without it the site is built, which needs the extra `site`.
"""

import functools
import http.server
import importlib.util
import io
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from browser import Browser, need_chromium
from PIL import Image

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

CUT = """[...document.querySelectorAll('article pre > code')]
  .filter(each => each.scrollWidth > each.clientWidth + 1).map(each => each.textContent.trim().split('\\n')[0])"""
SEARCH = """(() => { const field = document.querySelector('.md-search__input');
  field.focus(); field.value = 'perturbations'; field.dispatchEvent(new Event('keyup', {bubbles: true}));
  field.dispatchEvent(new Event('input', {bubbles: true})); })()"""
ANSWERED = """new Promise(done => { const look = () => document.querySelectorAll('.md-search-result__link').length
  ? done(true) : setTimeout(look, 50); look(); })"""
FOUND = (
    "[...document.querySelectorAll('.md-search-result__link')].map(each =>"
    " each.getAttribute('href'))"
)


class Links(HTMLParser):
    """What a page loads or leads to."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("href", "src") and value]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if folder := os.environ.get("FARM_SITE"):
        return Path(folder)
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("no mkdocs: pip install '.[site]'")
    folder = tmp_path_factory.mktemp("site")
    words = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--quiet",
        "--strict",
        "-f",
        "docs/mkdocs.yml",
        "-d",
        str(folder),
    ]
    subprocess.run(words, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    return folder


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=site)
    )
    threading.Thread(target=server.serve_forever).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    need_chromium()
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def value(browser: Browser, expression: str) -> object:
    return browser.call("Runtime.evaluate", expression=expression, returnByValue=True)[
        "result"
    ].get("value")


def pages(site: Path) -> list[str]:
    found = [
        str(page.parent.relative_to(site))
        for page in site.rglob("index.html")
        if page.parent.name != "viewer"
    ]
    return sorted("" if page == "." else f"{page}/" for page in found)


def test_every_file_that_a_page_names_exists(site: Path) -> None:
    assert len(pages(site)) > 30
    for page in pages(site):
        text = (site / page / "index.html").read_text("utf-8")
        links = Links(text).found
        assert any(".css" in link for link in links), f"{page} has no stylesheet"
        for link in links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or not parts.path:
                continue
            start = site if parts.path.startswith("/") else site / page
            target = Path(os.path.normpath(start / unquote(parts.path.lstrip("/"))))
            assert target.is_file() or (target / "index.html").is_file(), f"{page} names {link}"


def test_no_line_of_code_is_cut(site: Path, address: str, browser: Browser) -> None:
    cut = {}
    for page in pages(site):
        browser.open(f"{address}/{page}")
        if lines := value(browser, CUT):
            cut[page] = lines
    assert cut == {}


@pytest.mark.parametrize("page", ["", "docs/tutorial/", "docs/api/"])
def test_a_page_has_its_colours_its_navigation_and_its_text(
    address: str, browser: Browser, page: str
) -> None:
    browser.errors.clear()
    browser.open(f"{address}/{page}")
    picture = np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB")).astype(int)
    header = np.median(picture[:40], axis=(0, 1))
    assert header[2] > header[0] + 60, "the header is blue"
    darkness = 255 - picture.min(axis=2)
    navigation, text = darkness[80:400, 40:270], darkness[80:900, 300:1240]
    for part, least in ((navigation, 0.01), (text, 0.01)):
        assert least < float((part > 100).mean()) < 0.5, (
            "text on a light ground, and no picture that covers it"
        )
    assert browser.errors == []


def test_the_search_answers(address: str, browser: Browser) -> None:
    browser.open(f"{address}/")
    value(browser, SEARCH)
    answered = browser.call(
        "Runtime.evaluate", expression=ANSWERED, awaitPromise=True, returnByValue=True
    )
    assert answered["result"]["value"] is True
    links = value(browser, FOUND)
    assert isinstance(links, list)
    assert any("docs/" in link for link in links)
