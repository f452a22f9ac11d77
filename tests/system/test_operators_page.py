"""The operators' page in a real browser, on a running site: an alarm is seen, acknowledged, shelved and cleared.

Two browsers look at the same site, one of an operator and one of a viewer; the gateway is killed in between.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import BusConfig
from fantwin.schemas.topics import tray_key
from tests.support.page_browser import opened, running_browser
from tests.support.running_chain import SITE, TRAY, Chain, eventually, view_of
from tests.support.running_gateway import free_port
from tests.support.site_users import make_users

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY = 5
FAULT = f"rotor:fan={FAULTY},start=25,stop=75,size=1.0"
SCRIPT = '<img src=x onerror="document.title=1">'
SEEN = """() => new MutationObserver(() => {
    if (document.querySelector(".cell.alarm")) window.seen_ms ??= Date.now();
}).observe(document.body, {subtree: true, childList: true, attributes: true})"""
STAGES = ["acquisition", "resampler", "twin_integrator", "scorer", "recorder", "gateway"]


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[tuple[Chain, str]]:
    make_users(tmp_path / "users.toml")
    port = free_port()
    settings = (f"gateway.port={port}", f"gateway.users='{tmp_path / 'users.toml'}'")
    running = Chain(tmp_path, endpoint, *settings, f"launcher.stages={json.dumps(STAGES)}", viewer=False)
    try:
        yield running, f"http://127.0.0.1:{port}/"
    finally:
        running.close()


@pytest.fixture
def browser() -> Iterator[Browser]:
    with running_browser() as running:
        yield running


def test_an_alarm_is_seen_acknowledged_shelved_and_cleared_in_two_browsers(chain, browser):
    site, url = chain
    errors: list[str] = []
    presented_s: list[float] = []
    with site.watcher() as watcher, Bus(BusConfig(endpoint=site.endpoint), listens=False) as bus:
        bus.subscribe(tray_key(SITE, TRAY, "alarm"), lambda _key, _payload: presented_s.append(time.time()))
        site.start_up()
        eventually(lambda: (v := view_of(watcher, "gateway")) and v.alive, "the gateway is at work")
        ann, vic = (opened(browser, url, errors, name) for name in ("ann", "vic"))
        vic.evaluate(SEEN)
        site.start_tray("--fault", FAULT)
        cell = ann.get_by_role("button", name=f"{TRAY} fan {FAULTY} alarm")
        expect(cell).to_be_visible()
        expect(vic.get_by_role("button", name=f"{TRAY} fan {FAULTY} alarm")).to_be_visible()

        seen_s = vic.evaluate("window.seen_ms") / 1000
        print(f"from the bus to the page: {1000 * (seen_s - presented_s[0]):.0f} ms")

        cell.click()
        card = ann.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
        expect(card).to_contain_text("unacknowledged")
        expect(ann.locator("canvas")).to_have_count(4)
        vic.get_by_role("link", name="Alarms").click()
        shown = vic.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
        expect(shown).to_contain_text("vic may view but not act")
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
        ann.get_by_label("Reason").fill(SCRIPT)
        ann.get_by_role("dialog").get_by_role("button", name="Acknowledge").click()
        for page in (card, shown):
            expect(page).to_contain_text("acknowledged by ann")

        first = site.process_ids()["gateway"]
        site.kill(watcher, "gateway")
        assert site.process_ids()["gateway"] != first
        for page in (ann, vic):
            expect(page.locator("#connection")).to_contain_text("live")
        expect(shown).to_contain_text("acknowledged by ann")

        opened_again = opened(browser, url, errors, "ann")
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
        opened_again.get_by_label("Reason").fill("a door was open")
        opened_again.get_by_role("dialog").get_by_role("button", name="False alarm").click()
        expect(history).to_contain_text("(false alarm)")
        expect(shown).to_contain_text("marked as a false alarm by ann: a door was open")
        assert opened_again.title() != "1"
        assert errors == []
    assert SITE in ann.title()
