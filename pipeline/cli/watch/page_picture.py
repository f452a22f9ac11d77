"""A picture of a web page, taken by a browser that is installed: Chromium or one made of it, without a window.

It is driven over two pipes (Chrome DevTools Protocol), so no package is needed for it.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "brave-browser")
LIMIT_S = 30.0
POLL_S = 0.2
# A browser reads from descriptor 3 and writes to 4.
_START = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execv(sys.argv[3], sys.argv[3:])"
)


def installed_browser() -> str:
    """The path of a browser that can take a picture; empty: there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), "")


def take_picture(browser: str, url: str, ready: str, size: tuple[int, int], path: Path) -> str:
    """Open a page, wait until `ready`, an expression in JavaScript, is true there, and write a PNG.

    size: of the window, in pixels. Returns why there is no picture; empty: it has been taken.
    """
    with tempfile.TemporaryDirectory(prefix="fantwin-browser-", ignore_cleanup_errors=True) as profile:
        try:
            with _Browser(browser, size, Path(profile)) as page:
                image = page.picture(url, ready)
            path.write_bytes(image)
        except (OSError, ValueError, LookupError) as error:
            return f"{Path(browser).name} has taken none: {error}"
    return ""


class _Browser:
    """A running browser. Whoever waits for it longer than LIMIT_S finds it killed."""

    def __init__(self, program: str, size: tuple[int, int], profile: Path) -> None:
        to_browser, self._to = os.pipe()
        self._from, from_browser = os.pipe()
        options = ["--headless=new", "--disable-gpu", "--hide-scrollbars", "--no-first-run", "--remote-debugging-pipe"]
        options += [f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        if os.geteuid() == 0:
            options.append("--no-sandbox")  # the sandbox refuses to run as root
        # Both are above 4, so that neither is overwritten.
        to_browser, from_browser = _above_4(to_browser), _above_4(from_browser)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, str(to_browser), str(from_browser), program, *options, "about:blank"],
                pass_fds=(to_browser, from_browser),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        finally:
            os.close(to_browser)
            os.close(from_browser)
        self._size = size
        self._number = 0
        self._received = b""
        self._until_s = time.monotonic() + LIMIT_S
        self._timer = threading.Timer(LIMIT_S, self._process.kill)
        self._timer.start()

    def __enter__(self) -> _Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)

    def picture(self, url: str, ready: str) -> bytes:
        """A PNG of a page.

        Raises:
            OSError, ValueError, LookupError: there is none; says why.
        """
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        width, height = self._size
        self._ask(
            "Emulation.setDeviceMetricsOverride",
            session,
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self._ask("Page.navigate", session, url=url)
        while not self._ask("Runtime.evaluate", session, expression=ready)["result"].get("value"):
            if time.monotonic() > self._until_s:
                raise LookupError(f"the page does not show in {LIMIT_S:.0f} s what was waited for")
            time.sleep(POLL_S)
        return base64.b64decode(self._ask("Page.captureScreenshot", session, format="png")["data"])

    def _ask(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        sent = json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0"
        while sent:
            sent = sent[os.write(self._to, sent) :]
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise LookupError(answer["error"].get("message", method))
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._received:
            data = os.read(self._from, 1 << 20)
            if not data:
                raise LookupError("it has ended")
            self._received += data
        message, _, self._received = self._received.partition(b"\0")
        return json.loads(message)


def _above_4(descriptor: int) -> int:
    moved = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 5)
    os.close(descriptor)
    return moved
