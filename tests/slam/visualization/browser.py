"""A headless Chromium, driven over W3C WebDriver with the standard library alone; tests without one are skipped."""

import json
import re
import shutil
import subprocess
import tempfile
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

REASON = "" if shutil.which("chromedriver") else "chromedriver is not there (Debian: chromium-driver)"

_FLAGS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
#: Not through a proxy that the environment may name.
_OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


class Browser:
    """One window; `close` ends the browser and its driver."""

    def __init__(self, *, width: int = 1200, height: int = 900, scale: float = 1.0) -> None:
        if REASON:
            pytest.skip(REASON)
        self._profile = tempfile.TemporaryDirectory(prefix="chromium-")
        # port 0: the driver chooses a free one and says which
        command = [str(shutil.which("chromedriver")), "--port=0"]
        self._driver = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self._base = f"http://127.0.0.1:{self._port()}"
        flags = [*_FLAGS, f"--window-size={width},{height}", f"--force-device-scale-factor={scale}"]
        flags.append(f"--user-data-dir={self._profile.name}")
        wanted = {"goog:chromeOptions": {"args": flags}, "goog:loggingPrefs": {"browser": "ALL"}}
        try:
            answer = self._send("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        except Exception:
            self._end()
            raise
        self._base += f"/session/{answer['sessionId']}"

    def open(self, page: Path) -> None:
        """Load a file and wait until it is loaded."""
        self._send("POST", "/url", {"url": page.resolve().as_uri()})

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script returns."""
        return self._send("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def console(self) -> list[str]:
        """What the page wrote to the console since the last call: errors and warnings of the browser included."""
        return [entry["message"] for entry in self._send("POST", "/se/log", {"type": "browser"})]

    def point_at(self, x: float, y: float) -> None:
        """Move the mouse to a place in the window, px."""
        self._mouse([{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 0}])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press, move, release."""
        moves = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 30} for x, y in (start, end)]
        self._mouse([moves[0], {"type": "pointerDown", "button": 0}, moves[1], {"type": "pointerUp", "button": 0}])

    def close(self) -> None:
        """End the browser, then its driver."""
        try:
            self._send("DELETE", "")
        finally:
            self._end()

    def _mouse(self, actions: list[dict[str, Any]]) -> None:
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions}
        self._send("POST", "/actions", {"actions": [mouse]})

    def _port(self) -> int:
        assert self._driver.stdout is not None
        for line in self._driver.stdout:
            if found := re.search(r"started successfully on port (\d+)", line):
                return int(found.group(1))
        raise RuntimeError("chromedriver ended without having started")

    def _send(self, method: str, path: str, content: dict[str, Any] | None = None) -> Any:
        body = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(self._base + path, body, {"Content-Type": "application/json"}, method=method)
        try:
            with _OPENER.open(request, timeout=60) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from error

    def _end(self) -> None:
        self._driver.terminate()
        self._driver.wait(timeout=20)
        self._profile.cleanup()
