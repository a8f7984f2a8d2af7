"""Control a headless Chromium through its debugging pipe, with the standard library only. The browser loads only pages
of the harness.
"""

import contextlib
import json
import os
import select
import shutil
import subprocess
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from tests.machine import do_without

DEADLINE_S = 60.0
_FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
]


def chromium_or_skip() -> str:
    """Return the path of the browser. Without one, the test is skipped, or fails if UCP_REQUIRE contains `browser`."""
    found = (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name)))
    return next(found, None) or do_without("browser", "no chromium on PATH (Debian package `chromium`)")


class Browser:
    """A browser that shows one page at a time. `complaints` contains the messages in the browser's console."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._to, self._from = to_browser, from_browser
        self._sent = 0
        self._unread = b""
        self._loaded = False
        self._session: str | None = None
        self.complaints: list[str] = []

    @contextlib.contextmanager
    def fresh(self) -> Iterator["Browser"]:
        """Open an empty page that shares nothing with earlier pages, as in a new browser."""
        self.complaints = []
        context = self._call("Target.createBrowserContext")["browserContextId"]
        target = self._call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._call(f"{domain}.enable")
        yield self
        self._session = None
        self._call("Target.disposeBrowserContext", browserContextId=context)

    def show(self, page: Path | str, *, width: int, scheme: Literal["light", "dark"], height: int = 800) -> None:
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
        )
        self._call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self._loaded = False
        self._call("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        while not self._loaded:
            self._read()

    def evaluate(self, expression: str) -> Any:
        result = self._call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def press(self, key: str, text: str = "", *, shift: bool = False) -> None:
        arrows = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
        code = {" ": 32, "Tab": 9, "Enter": 13, "Home": 36, "n": 78, "+": 187, "-": 189, **arrows}[key]
        pressed = {"key": key, "windowsVirtualKeyCode": code, "modifiers": 8 if shift else 0}
        self._call("Input.dispatchKeyEvent", type="keyDown", text=text, **pressed)
        self._call("Input.dispatchKeyEvent", type="keyUp", **pressed)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag the mouse from one point of the window to another."""
        for event, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            self._call("Input.dispatchMouseEvent", type=event, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    @contextlib.contextmanager
    def on_paper(self) -> Iterator[None]:
        """Lay out the page as on paper inside the context."""
        self._call("Emulation.setEmulatedMedia", media="print")
        yield
        self._call("Emulation.setEmulatedMedia", media="")

    def screenshot(self, path: Path) -> None:
        """Write a picture of the whole page to `path`."""
        shot = self._call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(b64decode(shot["data"]))

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._sent += 1
        message: dict[str, Any] = {"id": self._sent, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            assert select.select([self._from], [], [], DEADLINE_S)[0], f"the browser is silent for {DEADLINE_S:g} s"
            data = os.read(self._from, 1 << 20)
            assert data, "the browser went away"
            self._unread += data
        message, self._unread = self._unread.split(b"\0", 1)
        answer: dict[str, Any] = json.loads(message)
        if answer.get("method") in ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
            self.complaints.append(json.dumps(answer["params"]))
        self._loaded |= answer.get("method") == "Page.loadEventFired"
        return answer


@contextlib.contextmanager
def open_browser(profile: Path) -> Iterator[Browser]:
    """Start a Chromium with a new, empty profile, and end it afterwards.

    Chromium expects the debugging pipe on file descriptors 3 and 4.
    """
    chromium = chromium_or_skip()
    its_input, to_browser = os.pipe()
    from_browser, its_output = os.pipe()
    process = subprocess.Popen(
        [
            "sh",
            "-c",
            f'exec "$@" 3</dev/fd/{its_input} 4>/dev/fd/{its_output}',
            "sh",
            chromium,
            *_FLAGS,
            f"--user-data-dir={profile}",
        ],
        pass_fds=(its_input, its_output),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(its_input)
    os.close(its_output)
    try:
        yield Browser(to_browser, from_browser)
    finally:
        os.close(to_browser)  # Chromium ends when its pipe closes
        os.close(from_browser)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
