"""The operators' page and the report in a real browser, driven by Playwright."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.support.node_packages import node_modules
from tests.support.running_chain import DEADLINE_S
from tests.support.site_users import PASSWORD

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
DEADLINE_MS = DEADLINE_S * 1000
AXE, AXE_VERSION = "axe-core", "4.14.1"
_RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]
_CHECK = """async (rules) => (await axe.run(document, {runOnly: rules})).violations
    .map((each) => `${each.id}: ${each.help}: ${each.nodes[0].html}`)"""


_MEASURE = """() => {
  const root = document.documentElement;
  const box = element => { const r = element.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; };
  const figures = [...document.querySelectorAll("figure")].map(figure => ({
    title: figure.querySelector("figcaption b").textContent,
    caption: box(figure.querySelector("figcaption")),
    svgs: [...figure.querySelectorAll("svg")].filter(svg => svg.getClientRects().length > 0).map(svg => ({
      box: box(svg), px_per_unit: box(svg)[2] / svg.viewBox.baseVal.width
    })),
  }));
  return {
    width: root.clientWidth, needs: root.scrollWidth, figures,
    tables: [...document.querySelectorAll("table")].map(table => box(table.parentElement)),
    fetched: performance.getEntriesByType("resource").map(entry => entry.name),
    background: getComputedStyle(document.body).backgroundColor,
  };
}"""


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Skips the test where there is none."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"no browser to look at the page with ({', '.join(BROWSERS)}); apt-get install chromium")
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []  # the sandbox refuses to run as root
    expect.set_options(timeout=DEADLINE_MS)
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path, args=arguments) as running:
        yield running


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


def measured(page: str, width_px: int) -> dict[str, Any]:
    """Lay a page out at a width and measure it."""
    with running_browser() as browser:
        view = browser.new_page(viewport={"width": width_px, "height": 900})
        view.set_content(page)
        return view.evaluate(_MEASURE)


def inaccessible(page: Page) -> list[str]:
    """What keeps people from using a page as it is now (WCAG 2.1 AA), by axe-core; skips the test where it is not."""
    modules = node_modules(AXE, AXE_VERSION, "check of accessibility")
    page.evaluate((modules / AXE / "axe.min.js").read_text(encoding="utf-8"))
    return page.evaluate(_CHECK, _RULES)
