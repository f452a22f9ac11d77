"""The operators' page in a real browser, driven by Playwright."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.support.browser import browser as browser_path
from tests.support.node_packages import node_modules
from tests.support.running_chain import DEADLINE_S
from tests.support.site_users import PASSWORD

DEADLINE_MS = DEADLINE_S * 1000
AXE, AXE_VERSION = "axe-core", "4.14.1"
_RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]
_CHECK = """async (rules) => (await axe.run(document, {runOnly: rules})).violations
    .map((each) => `${each.id}: ${each.help}: ${each.nodes[0].html}`)"""


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Skips the test where there is none."""
    path, arguments = browser_path(), ["--no-sandbox"] if os.geteuid() == 0 else []
    expect.set_options(timeout=DEADLINE_MS)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=arguments)
        try:
            yield running
        finally:
            running.close()


def opened(
    browser: Browser,
    url: str,
    errors: list[str],
    user: str = "",
    size: tuple[int, int] = (1280, 900),
    scheme: Literal["light", "dark"] = "light",
) -> Page:
    """The page in a browser of its own, logged in as a user if one is named. errors: those of its scripts. size: of the
    window, in pixels."""
    width_px, height_px = size
    page = browser.new_context(viewport={"width": width_px, "height": height_px}, color_scheme=scheme).new_page()
    page.set_default_timeout(DEADLINE_MS)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    expect(page.locator("#connection")).to_contain_text("live")
    if user:
        page.get_by_role("button", name="Log in").click()
        page.get_by_label("Name").fill(user)
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("dialog").get_by_role("button", name="Log in").click()
        expect(page.get_by_role("button", name="Log out")).to_be_visible()
    return page


def inaccessible(page: Page) -> list[str]:
    """What keeps people from using a page as it is now (WCAG 2.1 AA), by axe-core; skips the test where it is not."""
    modules = node_modules(AXE, AXE_VERSION, "check of accessibility")
    page.evaluate((modules / AXE / "axe.min.js").read_text(encoding="utf-8"))
    return page.evaluate(_CHECK, _RULES)
