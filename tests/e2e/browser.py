"""Debian's chromium without a screen, driven over its own pipe: no other package is needed."""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

_FLAGS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--window-size=1280,940",
)


def need_chromium() -> str:
    """The browser's path; the test is skipped where there is none."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium: apt-get install chromium")
    return program


class Browser:
    """One page of a browser of our own, and what its console said."""

    def __init__(self, home: Path) -> None:
        """Start it; `home` is for its profile."""
        self.errors: list[str] = []
        """What the console called an error, and exceptions that nobody caught."""
        input_end, self._write = os.pipe()
        self._read, ours = os.pipe()
        command = [need_chromium(), *_FLAGS, f"--user-data-dir={home}", "about:blank"]
        # The browser reads commands from descriptor 3 and writes to 4, whichever numbers the pipes
        # have here.
        shell = ["bash", "-c", f'exec 3<&{input_end} 4>&{ours} "$0" "$@"', *command]
        self._process = subprocess.Popen(
            shell, pass_fds=(input_end, ours), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(input_end)
        os.close(ours)
        self._waiting, self._number, self._session = b"", 0, ""
        pages = self.call("Target.getTargets")["targetInfos"]
        page = next(each["targetId"] for each in pages if each["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for part in ("Page", "Runtime", "Log"):
            self.call(f"{part}.enable")
        self.call("Fetch.enable", patterns=[{"urlPattern": "https://*"}])

    def __enter__(self) -> "Browser":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._process.terminate()
        self._process.wait(20)
        os.close(self._write)
        os.close(self._read)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask the browser to do something, and return what it answers."""
        number = self._post(method, **parameters)
        while (answer := self._next()).get("id") != number:
            self._note(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, address: str) -> None:
        """Go to a page, and wait until it is loaded."""
        self.call("Page.navigate", url=address)
        while (event := self._next()).get("method") != "Page.loadEventFired":
            self._note(event)

    def picture(self) -> bytes:
        """The page as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def _post(self, method: str, **parameters: Any) -> int:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        return self._number

    def _next(self) -> dict[str, Any]:
        until = time.monotonic() + 60
        while b"\0" not in self._waiting:
            assert select.select([self._read], [], [], max(0.0, until - time.monotonic()))[0], (
                "the browser is silent"
            )
            data = os.read(self._read, 1 << 20)
            assert data, "the browser has ended"
            self._waiting += data
        message, _, self._waiting = self._waiting.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        if event.get("method") == "Runtime.consoleAPICalled" and params["type"] in (
            "error",
            "assert",
        ):
            self.errors.append(
                " ".join(str(part.get("value", part.get("description"))) for part in params["args"])
            )
        elif event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"]))
        elif event.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
        elif event.get("method") == "Fetch.requestPaused":
            # The viewer asks its maker's machines for news: they answer nothing, with internet and
            # without.
            anybody = [
                {"name": f"Access-Control-Allow-{what}", "value": "*"}
                for what in ("Origin", "Headers")
            ]
            answer = {
                "responseCode": 200,
                "responseHeaders": anybody,
                "body": base64.b64encode(b"{}").decode(),
            }
            self._post("Fetch.fulfillRequest", requestId=params["requestId"], **answer)
