"""The operators' page in a real browser, on a running site: an alarm is seen, acknowledged, shelved and cleared.

Two browsers look at the same site, one of an operator and one of a viewer; the gateway is killed in between.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from pipeline.presenting.users import User, UserRole, hasher, write_users
from tests.support.browser import browser as browser_path
from tests.support.running_chain import DEADLINE_S, SITE, TRAY, Chain, eventually, view_of
from tests.support.running_gateway import free_port

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY, PASSWORD = 5, "correct horse battery"
FAULT = f"rotor:fan={FAULTY},start=25,stop=75,size=1.0"
SCRIPT = '<img src=x onerror="document.title=1">'
DEADLINE_MS = DEADLINE_S * 1000
STAGES = ["acquisition", "resampler", "twin_integrator", "scorer", "recorder", "gateway"]


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[tuple[Chain, str]]:
    hashed = hasher().hash(PASSWORD)
    users = {n: User(n, r, hashed) for n, r in (("ann", UserRole.OPERATOR), ("vic", UserRole.VIEWER))}
    write_users(tmp_path / "users.toml", users)
    port = free_port()
    settings = (f"gateway.port={port}", f"gateway.users='{tmp_path / 'users.toml'}'", "scorer.baseline_s=2")
    running = Chain(tmp_path, endpoint, *settings, f"launcher.stages={json.dumps(STAGES)}", viewer=False)
    try:
        yield running, f"http://127.0.0.1:{port}/"
    finally:
        running.close()


@pytest.fixture
def browser() -> Iterator[Browser]:
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=browser_path(), args=arguments)
        try:
            yield running
        finally:
            running.close()


def opened(browser: Browser, url: str, name: str, errors: list[str]) -> Page:
    """The page in a browser of its own, logged in."""
    page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.set_default_timeout(DEADLINE_MS)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    page.get_by_role("button", name="Log in").click()
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("dialog").get_by_role("button", name="Log in").click()
    expect(page.get_by_role("button", name="Log out")).to_be_visible()
    return page


def test_an_alarm_is_seen_acknowledged_shelved_and_cleared_in_two_browsers(chain, browser):
    site, url = chain
    expect.set_options(timeout=DEADLINE_MS)
    errors: list[str] = []
    with site.watcher() as watcher:
        site.start_up()
        eventually(lambda: (v := view_of(watcher, "gateway")) and v.alive, "the gateway is at work")
        ann, vic = (opened(browser, url, name, errors) for name in ("ann", "vic"))
        site.start_tray("--fault", FAULT)
        cell = ann.get_by_role("button", name=f"{TRAY} fan {FAULTY} alarm")
        expect(cell).to_be_visible()
        expect(vic.get_by_role("button", name=f"{TRAY} fan {FAULTY} alarm")).to_be_visible()

        cell.click()
        card = ann.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
        expect(card).to_contain_text("unacknowledged")
        expect(ann.locator("canvas")).to_have_count(3)
        vic.get_by_role("link", name="Alarms").click()
        shown = vic.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
        expect(shown).to_contain_text("vic may look, and not act")
        refused = vic.evaluate(
            """async (path) => {
                const me = await (await fetch("/api/v1/me")).json();
                const headers = {"Content-Type": "application/json", "X-CSRF-Token": me.csrf_token};
                return (await fetch(path, {method: "POST", headers, body: '{"action": "acknowledge"}'})).status;
            }""",
            f"/api/v1/fans/{TRAY}/{FAULTY}/requests",
        )
        assert refused == 403

        card.get_by_role("button", name="Acknowledge").click()
        ann.get_by_label("Why").fill(SCRIPT)
        ann.get_by_role("dialog").get_by_role("button", name="Acknowledge").click()
        for page in (card, shown):
            expect(page).to_contain_text("acknowledged by ann")

        first = site.process_ids()["gateway"]
        site.kill(watcher, "gateway")
        assert site.process_ids()["gateway"] != first
        for page in (ann, vic):
            expect(page.locator("#connection")).to_contain_text("live")
        expect(shown).to_contain_text("acknowledged by ann")

        opened_again = opened(browser, url, "ann", errors)
        opened_again.get_by_role("link", name="Alarms").click()
        again = opened_again.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
        again.get_by_role("button", name="Shelve").click()
        opened_again.get_by_label("How long").select_option(label="2 hours")
        opened_again.get_by_role("dialog").get_by_role("button", name="Shelve").click()
        expect(again).to_contain_text("shelved until")
        expect(shown).to_contain_text("shelved until")
        expect(vic.locator("#alarm-count")).to_have_text("")
        expect(again.get_by_text("over")).to_be_visible()

        opened_again.get_by_role("link", name="History").click()
        history = opened_again.locator("tbody")
        for words in ("raised", "acknowledged", "shelved", "cleared", SCRIPT):
            expect(history).to_contain_text(words)
        history.locator("tr", has_text="raised").first.get_by_role("button", name="False alarm").click()
        opened_again.get_by_label("Why").fill("a door was open")
        opened_again.get_by_role("dialog").get_by_role("button", name="False alarm").click()
        expect(history).to_contain_text("(false alarm)")
        expect(shown).to_contain_text("marked as a false alarm by ann: a door was open")
        assert opened_again.title() != "1"
        assert errors == []
    assert SITE in ann.title()
