"""The operators' page in a real browser, on a gateway that is fed with messages: keyboard, accessibility, attacks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from fantwin.schemas.enums import Action, FanState, Feedback, Transition
from fantwin.schemas.messages import Alarm, Diagnosis, Request
from tests.support.page_browser import inaccessible, opened
from tests.support.running_core import FANS, TRAY
from tests.support.running_gateway import RunningGateway
from tests.support.site_messages import NOW_NS, alarm, golden_twin, marked, score
from tests.support.site_users import PASSWORD, make_users

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("quickly_hashed")]
FAULTY = 2
CARD = f"fan {FAULTY} ✖ in alarm"
FOCUSED = "(document.activeElement.ariaLabel ?? document.activeElement.innerText).replace(/\\s+/g, ' ').trim()"
SIZES = [(1600, 1000), (1280, 800), (820, 1180), (390, 844)]
SCRIPT = '<img src=x onerror="document.title=1"><script>document.title=1</script>'

NAME = '<img src=x onerror="document.title=1">'


class Scorer:
    """Grants what is asked."""

    def __init__(self) -> None:
        self._state = {"acknowledged": False, "shelved_until_t_ns": 0}

    def __call__(self, request: Request) -> list[Alarm]:
        if request.action == Action.FALSE_ALARM:
            return [replace(marked(Feedback.FALSE_ALARM, 2, request.comment), marked_onset_t_ns=5)]
        transition, change = {
            Action.ACKNOWLEDGE: (Transition.ACKNOWLEDGED, {"acknowledged": True}),
            Action.SHELVE: (Transition.SHELVED, {"shelved_until_t_ns": alarm().t_ns + round(request.duration_s * 1e9)}),
        }[request.action]
        self._state |= change
        name, comment = request.operator_name, request.comment
        granted = alarm(transition, operator_name=name, comment=comment, message=f"{name} asks", **self._state)
        return [replace(granted, fan=fan) for fan in (range(FANS) if request.fan < 0 else [FAULTY])]


@pytest.fixture
def gateway(tmp_path: Path, never_silent: None) -> Iterator[RunningGateway]:
    running = RunningGateway(tmp_path, Scorer(), users=make_users(tmp_path / "users.toml"))
    running.feed(score(), score(1.0, state=FanState.ALARM), alarm())
    try:
        yield running
    finally:
        running.close()


def test_a_fan_is_shown_by_its_name_first_on_every_view_and_a_name_is_text(tmp_path, never_silent, browser):
    errors: list[str] = []
    fans = [{}, {}, {"name": NAME, "place": "rack <3>"}, {}]
    label, in_full = f"{NAME} (fan {FAULTY})", f"{NAME} ({TRAY} fan {FAULTY})"
    running = RunningGateway(tmp_path, fans=fans)
    try:
        running.feed(score(), alarm(fan_name=NAME, message=f"{NAME} (fan 2): 90 rpm below the twin"))
        page = opened(browser, f"http://127.0.0.1:{running.port}/", errors)
        expect(page.locator(".fan", has_text=label).locator(".where")).to_contain_text("rack <3>")
        expect(page.locator(".fan", has_text="fan 0")).to_be_visible()
        page.goto(f"http://127.0.0.1:{running.port}/#/fan/{TRAY}/{FAULTY}")
        expect(page.get_by_role("heading", name=label, exact=True)).to_be_visible()
        expect(page.locator(".where").first).to_contain_text("rack <3>")
        page.goto(f"http://127.0.0.1:{running.port}/#/alarms")
        card = page.locator("article", has_text=label)
        expect(card.get_by_text("90 rpm below the twin", exact=True)).to_be_visible()
        page.goto(f"http://127.0.0.1:{running.port}/#/history")
        expect(page.locator("summary", has_text=in_full)).to_be_visible()
        assert not errors and page.title() != "1"
    finally:
        running.close()


def test_everything_is_done_by_keyboard(gateway, browser):
    errors: list[str] = []
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/", errors, "ann")
    keyboard = page.keyboard

    def tab_to(name: str) -> None:
        for _ in range(40):
            keyboard.press("Tab")
            if name in page.evaluate(FOCUSED):
                assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
                return
        raise AssertionError(f"Tab does not come to {name!r}")

    expect(page.get_by_role("link", name=CARD)).to_be_visible()
    page.locator("#content").focus()
    tab_to(CARD)
    keyboard.press("ArrowRight")
    assert page.evaluate(FOCUSED).startswith("fan 3")
    keyboard.press("ArrowLeft")
    keyboard.press("Enter")
    card = page.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
    expect(card).to_be_visible()
    for button, done in (("Acknowledge", "by ann"), ("Shelve", "shelved until")):
        tab_to(button)
        keyboard.press("Enter")
        page.get_by_label("Reason").focus()
        keyboard.type(f"{button} by key")
        keyboard.press("Enter")
        expect(page.get_by_role("dialog")).to_be_hidden()
        expect(card).to_contain_text(done)
        expect(card.get_by_role("button", name=button, exact=True)).to_have_count(0)
        assert page.evaluate("document.activeElement !== document.body"), "the focus is lost"
        page.locator("#content").focus()
    asked = [(each.action, each.operator_name, each.comment) for each in gateway.sent]
    assert asked == [
        (Action.ACKNOWLEDGE, "ann", "Acknowledge by key"),
        (Action.SHELVE, "ann", "Shelve by key"),
    ]
    keyboard.press("Escape")
    expect(page.get_by_role("link", name=f"fan {FAULTY} ◌ silenced")).to_be_focused()
    assert errors == []


def test_what_an_operator_says_of_an_alarm_is_seen_by_a_viewer_and_the_rate_once_it_says_something(gateway, browser):
    errors: list[str] = []
    url = f"http://127.0.0.1:{gateway.port}/"
    gateway.feed(golden_twin(), score(2.0), score(6.0))
    early = opened(browser, f"{url}#/history", errors)
    expect(early.locator("main")).to_contain_text("drag, 80 %")
    expect(early.locator("#alarm-rate")).to_be_hidden()
    hours = [replace(score(2000.0 * step), period_ns=2000 * 10**9) for step in (1, 2, 3)]
    gateway.feed(*hours, alarm(sequence=1, onset_t_ns=5, t_ns=NOW_NS + 3 * 10**9))
    ann, vic = (opened(browser, f"{url}#/alarms", errors, name) for name in ("ann", "vic"))
    shown = vic.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
    expect(shown).to_contain_text("vic may view but not act")
    ann.get_by_role("link", name="History").click()
    expect(ann.locator("#alarm-rate")).to_contain_text("0, that is 0 per fan and day (95 % interval 0 to")
    fault = ann.locator("details.fault").first
    fault.locator("summary").click()
    fault.get_by_role("button", name="False alarm").click()
    ann.get_by_label("Reason").fill("a door was open")
    ann.get_by_role("dialog").get_by_role("button", name="False alarm").click()
    expect(fault).to_contain_text("false alarm")
    expect(shown).to_contain_text("marked as a false alarm by ann: a door was open")
    early.reload()
    expect(early.locator("#alarm-rate")).to_contain_text("1, that is")
    assert errors == []


def test_whoever_must_log_in_is_asked_again_after_a_restart_and_sees_the_page_again(tmp_path, browser):
    settings = {"users": make_users(tmp_path / "users.toml"), "hosts": ("127.0.0.1", "fans.example")}
    running = RunningGateway(tmp_path, **settings)
    page = browser.new_page()

    def log_in() -> None:
        page.get_by_label("Name").fill("vic")
        page.get_by_label("Password").fill(PASSWORD)
        page.get_by_role("dialog").get_by_role("button", name="Log in").click()
        expect(page.locator("#connection")).to_contain_text("live")

    try:
        page.goto(f"http://127.0.0.1:{running.port}/")
        log_in()
        running.close()
        expect(page.locator("#connection")).to_contain_text("no connection")
        running = RunningGateway(tmp_path, port=running.port, **settings)
        log_in()
        running.feed(score())
        expect(page.get_by_role("link", name="fan 0")).to_be_visible()
    finally:
        running.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_accessible_and_fits_all_screens(scheme, gateway, browser):
    errors: list[str] = []
    url = f"http://127.0.0.1:{gateway.port}/"
    page = opened(browser, url, errors, "ann", size=SIZES[0], scheme=scheme)
    found: dict[str, list[str]] = {}
    views = {
        "fans": "drag, 80 %",
        f"fan/{TRAY}/{FAULTY}": "Evidence of each cause",
        "alarms": "drag +20 %",
        "stages": "Stages",
        "history": "drag, 80 %",
    }
    for view, shown in views.items():
        page.goto(f"{url}#/{view}")
        expect(page.locator("main")).to_contain_text(shown)
        for width_px, height_px in SIZES:
            page.set_viewport_size({"width": width_px, "height": height_px})
            page.wait_for_function("document.documentElement.scrollWidth <= window.innerWidth")
        found[view] = inaccessible(page)
    header = page.locator("header").bounding_box()
    assert header is not None and header["height"] < 90, "two rows on a phone"
    page.goto(f"{url}#/alarms")
    page.get_by_role("button", name="Shelve").click()
    found["dialog"] = inaccessible(page)
    assert {view: problems for view, problems in found.items() if problems} == {}
    assert errors == []


def test_a_script_in_a_comment_is_shown_as_text(gateway, browser):
    errors: list[str] = []
    gateway.feed(
        alarm(Transition.ACKNOWLEDGED, 1, acknowledged=True, operator_name="ann", comment=SCRIPT, message=SCRIPT)
    )
    ann = opened(browser, f"http://127.0.0.1:{gateway.port}/", errors, "ann")
    ann.get_by_role("link", name="History").click()
    expect(ann.locator("main")).to_contain_text(SCRIPT)
    assert ann.locator("main img").count() == 0
    assert ann.title() != "1"
    assert errors == []


def test_a_stopped_fan_stays_in_alarm_filters_are_kept_and_all_alarms_of_a_tray_are_acknowledged(gateway, browser):
    errors: list[str] = []
    url = f"http://127.0.0.1:{gateway.port}/"
    tie = (Diagnosis(cause="blocked", probability=0.4), Diagnosis(cause="no_power", probability=0.4))
    stopped = score(2.0, state=FanState.STOPPED)
    stopped = replace(stopped, score=np.full_like(stopped.score, np.nan))
    gateway.feed(alarm(sequence=1, causes=tie), replace(alarm(sequence=2), fan=1), stopped)
    page = opened(browser, url, errors, "ann")
    cell = page.get_by_role("link", name=CARD)
    expect(cell).to_contain_text("blocked or no power, 40 % each; now stopped by its command")
    expect(page.locator("#summary")).to_contain_text("2 in alarm")
    page.get_by_role("button", name="2 in alarm").click()
    expect(page.get_by_role("link", name="normal")).to_have_count(0)
    page.reload()
    expect(page.get_by_role("button", name="2 in alarm")).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("link", name="normal")).to_have_count(0)
    cell.click()
    expect(page.locator("main .state")).to_contain_text("alarm, now stopped by its command")
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="2 in alarm")).to_have_attribute("aria-pressed", "true")

    page.get_by_role("link", name="Alarms (2)").click()
    heading = page.get_by_role("heading", name="Alarms (2): 2 active")
    expect(heading).to_be_in_viewport()
    header = page.locator("header").bounding_box()
    shown = heading.bounding_box()
    assert header is not None and shown is not None and shown["y"] >= header["height"], "the header hides it"
    card = page.locator(f'article[data-fan="{TRAY}/{FAULTY}"]')
    expect(card).to_contain_text("blocked or no power, 40 % each")
    expect(card).to_contain_text("now stopped by its command")
    gateway.feed(score(3.0, state=FanState.RETURNING))
    expect(card).to_contain_text("now like a healthy fan again")
    page.get_by_role("button", name=f"Acknowledge all 2 of {TRAY}").click()
    page.get_by_role("dialog").get_by_role("button", name="Acknowledge all").click()
    expect(page.get_by_role("dialog")).to_be_hidden()
    (asked,) = gateway.sent
    assert (asked.action, asked.fan, asked.operator_name) == (Action.ACKNOWLEDGE, -1, "ann")
    page.goto(f"{url}#/fan/{TRAY}/77")
    expect(page.locator("main")).to_contain_text(f"There is no fan 77 of {TRAY}")
    assert errors == []
