"""The operators' page of a running demo: its address, and a picture of it while a fan is in alarm."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from pathlib import Path

from fantwin.pipeline.cli.watch.page_picture import BROWSERS, LIMIT_S, installed_browser, take_picture
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.site.loopback import LOOPBACK

PICTURE = "page.png"
SIZE = (1280, 1560)
AFTER_S = 2.5
"""of the alarm: its cause is known, and the plots show how it began"""
_READY = (
    "document.querySelector('#connection').textContent.includes('live') && !!document.querySelector('article') && "
    "[...document.querySelectorAll('.key .value')].some((each) => /[0-9]/.test(each.textContent))"
)


class DemoPage:
    """Takes the picture in a thread of its own, while the demo goes on."""

    def __init__(self, config: Config, out: Path, fan: int) -> None:
        """fan: the one that is shown, while it is in alarm. Without the stage gateway there is no page."""
        section = config.sections.get("gateway")
        self.address = f"http://{LOOPBACK}:{section.port}/" if section else ""  # pyright: ignore[reportAttributeAccessIssue]
        self._url = f"{self.address}#/fan/{config.trays[0].name}/{fan}"
        self._fan = fan
        self._file = out / PICTURE
        self._browser = installed_browser()
        self._in_alarm_s: float | None = None
        self._thread: threading.Thread | None = None
        self._missing_because = "" if self._browser else f"it needs a browser: one of {', '.join(BROWSERS)}"

    def look(self, fans_in_alarm: Collection[int]) -> None:
        """Called while the demo runs."""
        if not (self.address and self._browser) or self._thread:
            return
        now_s = time.monotonic()
        if self._in_alarm_s is None and self._fan in fans_in_alarm:
            self._in_alarm_s = now_s
        if self._in_alarm_s is not None and now_s - self._in_alarm_s >= AFTER_S:
            self._thread = threading.Thread(target=self._take, daemon=True)
            self._thread.start()

    def finish(self) -> str:
        """Wait for the picture; returns why there is none, empty if there is one or no page."""
        if self._thread:
            self._thread.join(2 * LIMIT_S)
        elif self.address and self._browser:
            self._missing_because = f"fan {self._fan} was not in alarm for {AFTER_S:g} s"
        return self._missing_because if self.address else ""

    def _take(self) -> None:
        self._missing_because = take_picture(self._browser, self._url, _READY, SIZE, self._file)
