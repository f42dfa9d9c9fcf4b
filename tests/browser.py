"""A headless Chromium for tests of pages, by the WebDriver protocol of its own driver."""

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

NEEDED = ("chromium", "chromedriver")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
PATIENCE = 30  # seconds until the driver answers


def missing() -> list[str]:
    """What of it is not on this machine."""
    return [name for name in NEEDED if shutil.which(name) is None]


class Browser:
    """One session; the page that is open in it is asked and looked at."""

    def __init__(self, port: int, profile: Path):
        self._root = f"http://127.0.0.1:{port}"
        self._wait()
        options = {"args": [*FLAGS, f"--user-data-dir={profile}"]}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        session = self._call("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._session = f"/session/{session['sessionId']}"

    def open(self, page: Path, width: int, height: int, dark: bool = False, at: str = "") -> None:
        """Opens a page in a window of a size, light or dark, at what the address names."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500},
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", {"features": [scheme]})
        self._call("POST", f"{self._session}/url", {"url": "about:blank"})
        self._call("POST", f"{self._session}/url", {"url": f"{page.as_uri()}{at}"})
        # on a busy machine the driver comes back from a long page before its end
        ends = time.monotonic() + PATIENCE
        while self.ask("return document.readyState") != "complete" and time.monotonic() < ends:
            time.sleep(0.1)

    def command(self, name: str, given: dict[str, Any]) -> None:
        """A command of the browser's own protocol."""
        self._call("POST", f"{self._session}/goog/cdp/execute", {"cmd": name, "params": given})

    def ask(self, script: str) -> Any:
        """What a script in the page returns."""
        return self._call("POST", f"{self._session}/execute/sync", {"script": script, "args": []})

    def said(self) -> list[str]:
        """What the page has said on the console since it was last asked."""
        found = self._call("POST", f"{self._session}/se/log", {"type": "browser"})
        return [line["message"] for line in found]

    def screenshot(self, path: Path) -> None:
        """The window as a PNG, for who wants to look."""
        path.write_bytes(base64.b64decode(self._call("GET", f"{self._session}/screenshot")))

    def close(self) -> None:
        """Ends the session."""
        self._call("DELETE", self._session)

    def _call(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        sent = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = Request(self._root + path, sent, headers, method=method)
        with urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]

    def _wait(self) -> None:
        ends = time.monotonic() + PATIENCE
        while time.monotonic() < ends:
            with suppress(URLError, ConnectionError):
                if self._call("GET", "/status")["ready"]:
                    return
            time.sleep(0.1)
        raise RuntimeError("The driver of the browser does not answer.")


@contextmanager
def browser(profile: Path) -> Iterator[Browser]:
    """A browser with an empty profile, closed at the end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(["chromedriver", f"--port={port}"], stdout=quiet, stderr=quiet) as driver:
        try:
            opened = Browser(port, profile)
            yield opened
            opened.close()
        finally:
            driver.terminate()
