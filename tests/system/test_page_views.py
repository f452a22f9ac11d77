"""What the views of the operators' page show, as a user sees it in a real browser."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from fantwin.pipeline.site import site_model
from fantwin.schemas.enums import Action, FanState, InvalidReason, Transition
from fantwin.schemas.health import FanLearning, Health, Learning, Sweep
from fantwin.schemas.messages import Alarm, Diagnosis, Request, Score
from fantwin.schemas.units import RAD_S_PER_UNIT
from tests.support.made_messages import health
from tests.support.page_browser import inaccessible, opened
from tests.support.running_core import TRAY
from tests.support.running_gateway import RunningGateway
from tests.support.site_messages import NOW_NS, alarm, score
from tests.support.site_users import make_users

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("never_silent")]
SPIKE_RPM = 1400.0
TOPMOST = """(plot) => {
    const canvas = plot.querySelector("canvas"), context = canvas.getContext("2d");
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    for (let y = 0; y < canvas.height; y++) for (let x = 70; x < canvas.width - 20; x++) {
        const at = 4 * (y * canvas.width + x);
        if (data[at] < 60 && data[at + 1] < 60 && data[at + 2] < 60 && data[at + 3] > 200) return y / canvas.height;
    }
    return 1;
}"""
"""how far from the top of a plot its measured line begins, as a share of its height"""
RED_SHARE = """(plot) => {
    const canvas = plot.querySelector("canvas"), context = canvas.getContext("2d");
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    let red = 0;
    for (let at = 0; at < data.length; at += 4) red += data[at] > 150 && data[at + 1] < 60 && data[at + 3] > 100;
    return red / (canvas.width * canvas.height);
}"""
"""how much of a plot is filled as over the limit"""


NOTIFICATIONS = """window.notified = [];
window.Notification = class {
    static permission = "granted";
    static async requestPermission() { return "granted"; }
    constructor(title, more) { window.notified.push(`${title}: ${more.body}`); }
};"""


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[RunningGateway]:
    running = RunningGateway(tmp_path)
    try:
        yield running
    finally:
        running.close()


def shown_s(page: Page) -> tuple[int, int]:
    """The time shown, from and to, in seconds of the browser's clock."""
    values = page.evaluate(
        '["from", "to"].map((id) => new Date(document.getElementById(id).value || 0).getTime() / 1000)'
    )
    return tuple(values)


def with_spike(block: Score) -> Score:
    measured = block.measured_speed_rad_s.copy()
    measured[len(measured) // 2] = SPIKE_RPM * RAD_S_PER_UNIT["rpm"]
    return replace(block, measured_speed_rad_s=measured)


def test_a_card_says_what_a_fan_does_and_why_it_is_in_alarm(gateway, browser):
    errors: list[str] = []
    gateway.feed(*(score(float(second)) for second in range(30)), score(30.0, state=FanState.ALARM), alarm())
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/", errors)
    card = page.locator(f'[data-fan="{TRAY}/2"]')
    for text in ("1,000 rpm", "command 0.5", "in alarm", "drag, 80 %"):
        expect(card).to_contain_text(text)
    expect(page.locator(f'[data-fan="{TRAY}/0"]')).to_contain_text("50 % of the alarm limit")
    assert page.locator(".fan").first.get_attribute("data-fan") == f"{TRAY}/2", "the worst is first"
    drawn = card.locator(".spark-line").get_attribute("d") or ""
    assert drawn.count("L") >= 28, "the minute before the page was opened is there at once"
    assert (card.locator(".spark-band").get_attribute("d") or "").endswith("Z")
    right_px = page.evaluate(
        "Math.max(...[...document.querySelectorAll('.fan')].map((e) => e.getBoundingClientRect().right))"
    )
    assert right_px > 1280 - 40, "cards fill the width"
    assert errors == []


def test_a_card_says_why_a_fan_is_not_judged_and_does_not_break_a_number(tmp_path, browser):
    errors: list[str] = []
    running = RunningGateway(tmp_path, fans=[{"name": "radiator of the second pump, left"}, {}, {}, {}])
    no_twin = replace(score(1.0), invalid_reason=np.full((5, 4), InvalidReason.NO_TWIN, np.uint8))
    try:
        running.feed(score())
        page = opened(browser, f"http://127.0.0.1:{running.port}/", errors, size=(390, 844))
        unjudged = page.locator(f'[data-fan="{TRAY}/3"]')
        expect(unjudged).to_contain_text("not judged")
        expect(unjudged.locator(".why")).to_have_text("samples are missing")
        running.feed(no_twin)
        expect(unjudged.locator(".why")).to_contain_text("there is no twin yet")
        number = page.locator(f'[data-fan="{TRAY}/0"]').get_by_text("(fan 0)", exact=True)
        assert number.evaluate("(shown) => shown.getClientRects().length") == 1
    finally:
        running.close()
    assert errors == []


def test_a_silent_fan_says_since_when(tmp_path, browser, monkeypatch):
    errors: list[str] = []
    monkeypatch.setattr(site_model, "SILENT_AFTER_S", 0.0)
    running = RunningGateway(tmp_path)
    try:
        page = opened(browser, f"http://127.0.0.1:{running.port}/", errors)
        why = page.locator(".fan .why").first
        expect(why).to_have_text("no sample yet")
        running.feed(replace(score(), t_ns=time.time_ns() - 600 * 10**9 + np.arange(5)))
        expect(why).to_have_text("no sample for 10 min")
    finally:
        running.close()
    assert errors == []


def test_the_deviation_is_filled_only_while_it_is_over_the_alarm_limit(gateway, browser):
    errors: list[str] = []
    outside = [replace(score(float(second)), band_variance=np.full((5, 4), 0.01, np.float32)) for second in range(60)]
    gateway.feed(*outside)
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/2", errors)
    page.get_by_role("button", name="1 min", exact=True).click()
    plot = page.get_by_role("region", name="Deviation: measured minus twin")
    expect(plot).to_contain_text("deviation −10 rpm")
    assert plot.evaluate(RED_SHARE) == 0, "outside the band, but no alarm"
    gateway.feed(*(replace(each, t_ns=each.t_ns + 60 * 10**9, score=each.score + 1) for each in outside))
    page.wait_for_function(f"(plot) => ({RED_SHARE})(plot) > 0.3", arg=plot.element_handle())
    assert errors == []


def test_fingers_move_and_stretch_the_time_and_it_stays(gateway, browser):
    errors: list[str] = []
    gateway.feed(*(score(float(second)) for second in range(40)))
    page = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True).new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/0")
    plot = page.locator(".plot").first
    expect(plot).to_contain_text("measured 1,000 rpm")
    from_s, to_s = shown_s(page)
    area = plot.locator(".u-over")
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    assert box is not None
    at = {"x": box["x"], "y": box["y"] + box["height"] / 2, "width": box["width"]}
    fingers = page.context.new_cdp_session(page)

    def touch(kind: str, *shares: float) -> None:
        points = [
            {"x": at["x"] + share * at["width"], "y": at["y"], "id": number} for number, share in enumerate(shares)
        ]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 0.5, 0.6)
    touch("touchMove", 0.3, 0.8)
    touch("touchEnd")
    expect(page.get_by_role("button", name="● Live")).to_be_visible()
    stretched = shown_s(page)
    assert stretched[1] - stretched[0] == pytest.approx((to_s - from_s) / 5, abs=3)
    assert stretched[0] + 0.3 * (stretched[1] - stretched[0]) == pytest.approx((from_s + to_s) / 2, abs=3)
    touch("touchStart", 0.5)
    touch("touchMove", 0.75)
    touch("touchEnd")
    moved = shown_s(page)
    assert moved[0] - stretched[0] == pytest.approx(-0.25 * (stretched[1] - stretched[0]), abs=3)
    gateway.feed(*(replace(score(float(second)), command=np.full((5, 4), 0.7, np.float32)) for second in range(40, 50)))
    expect(page.locator(".title .command")).to_contain_text("0.7")
    assert shown_s(page) == moved
    assert errors == []


def test_the_axis_is_the_window_and_a_zoom_stays_while_samples_come(gateway, browser):
    errors: list[str] = []
    gateway.feed(*(score(float(second)) for second in range(40)))
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/0", errors)
    plot = page.locator(".plot").first
    expect(plot).to_contain_text("measured 1,000 rpm")
    from_s, to_s = shown_s(page)
    assert to_s - from_s == pytest.approx(600, abs=1), "the axis is the window, though only 40 s were heard"
    plot.evaluate("(shown) => { shown.isKept = true; }")
    area = plot.locator(".u-over")
    box = area.bounding_box()
    assert box is not None
    at_y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.2 * box["width"], at_y)
    expect(page.locator(".at")).to_contain_text("at 20")
    page.mouse.down()
    page.mouse.move(box["x"] + 0.4 * box["width"], at_y, steps=4)
    page.mouse.up()
    expect(page.get_by_role("button", name="● Live")).to_be_visible()
    zoomed = shown_s(page)
    assert zoomed[1] - zoomed[0] == pytest.approx(120, abs=3)
    assert zoomed[0] == pytest.approx(from_s + 120, abs=3)
    for second in range(40, 60):
        gateway.feed(score(float(second), state=FanState.NORMAL))
    gateway.feed(replace(score(60.0), command=np.full((5, 4), 0.7, np.float32)))
    expect(page.locator(".title .command")).to_contain_text("0.7")
    assert shown_s(page) == zoomed
    area.dblclick()
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    expect(plot).to_contain_text("measured")
    page.wait_for_function("(was) => new Date(document.getElementById('to').value).getTime() / 1000 > was", arg=to_s)
    page.get_by_role("button", name="Pause").click()
    paused = shown_s(page)
    gateway.feed(score(80.0))
    expect(page.get_by_role("button", name="● Live")).to_be_visible()
    assert shown_s(page) == paused
    assert plot.evaluate("(shown) => shown.isKept"), "what is dragged over is not made again when the past comes"
    assert errors == []


def test_a_spike_of_one_sample_is_seen_in_an_hour_and_downloads_hold_what_is_shown(gateway, browser):
    errors: list[str] = []
    quiet = [score(0.5 * step, samples=50) for step in range(600)]
    gateway.feed(*quiet[:300], with_spike(quiet[300]), *quiet[301:])
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/0", errors)
    page.get_by_role("button", name="1 h").click()
    speed = page.locator(".plot").first
    expect(page.get_by_role("button", name="1 h")).to_have_attribute("aria-pressed", "true")
    expect(speed).to_contain_text("measured 1,000 rpm")
    assert speed.evaluate(TOPMOST) < 0.2, "the measured line reaches up to the spike"
    with page.expect_download() as csv:
        page.get_by_role("link", name="CSV").click()
    table = csv.value.path().read_text()
    assert table.startswith("time,deviation_rpm_min") and f"{SPIKE_RPM:g}" in table
    with page.expect_download() as png:
        page.get_by_role("button", name="PNG").click()
    assert png.value.suggested_filename.startswith(f"{TRAY}-fan0-")
    assert png.value.path().read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and png.value.path().stat().st_size > 20_000
    assert errors == []


def test_marks_say_when_an_alarm_came_and_what_operators_did_and_evidence_is_drawn(gateway, browser):
    errors: list[str] = []
    later = (Diagnosis(cause="drag_up", probability=0.9), Diagnosis(cause="friction_up", probability=0.1))
    gateway.feed(*(score(float(second)) for second in range(300)))
    gateway.feed(
        alarm(t_ns=NOW_NS + 100 * 10**9),
        alarm(Transition.DIAGNOSED, 1, t_ns=NOW_NS + 200 * 10**9, causes=later),
        alarm(
            Transition.ACKNOWLEDGED,
            2,
            t_ns=NOW_NS + 290 * 10**9,
            operator_name="ann",
            comment="filter ordered",
            acknowledged=True,
            causes=later,
        ),
    )
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/2", errors)
    marks = page.locator(".mark")
    expect(marks).to_have_count(3)
    marks.nth(2).focus()
    marks.nth(2).press("Shift")
    expect(marks.nth(2)).to_have_attribute("aria-label", re.compile("acknowledged by ann: .*filter ordered"))
    expect(page.locator(".mark-list li")).to_have_count(3)
    page.wait_for_function(
        """() => {
            const area = document.querySelector(".plot .u-over").getBoundingClientRect();
            const mark = document.querySelectorAll(".mark")[1].getBoundingClientRect();
            return Math.abs((mark.x + mark.width / 2 - area.x) / area.width - 5 / 6) < 0.02;
        }"""
    )
    evidence = page.get_by_role("region", name="Evidence of each cause")
    expect(evidence).to_contain_text("more drag 90 %")
    page.get_by_text("Course of the alarm").click()
    expect(page.locator(".course")).to_contain_text("filter ordered")
    assert errors == []


def test_without_a_twin_a_fan_is_learning_and_the_page_says_how_far_and_what_helps(gateway, browser):
    errors: list[str] = []
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/", errors)
    expect(page.locator("main")).to_contain_text("No sample has come from any fan yet")
    untaught = replace(
        score(),
        state=np.zeros((5, 4), np.uint8),
        valid=np.zeros((5, 4), np.bool_),
        invalid_reason=np.full((5, 4), InvalidReason.NO_TWIN, np.uint8),
    )
    fans = [FanLearning(progress=0.4, missing=""), FanLearning(progress=0.3, missing="3 changes (10 needed)")]
    learning = Learning(
        tray=TRAY, what="4 of 10 minutes recorded", until_t_ns=NOW_NS, helps="move them", fans=(*fans, *fans)
    )
    gateway.feed(untaught, health("learner", learning=(learning,)))
    expect(page.locator(".fan.learning")).to_have_count(4)
    expect(page.locator(".fan").first).to_contain_text("40 % learned")
    panel = page.get_by_role("region", name=f"Learning of {TRAY}")
    for text in (
        "4 of 10 minutes",
        "at about",
        "fan 1",
        "30 %",
        "3 changes (10 needed)",
        f"command --tray {TRAY} --sweep",
    ):
        expect(panel).to_contain_text(text)
    expect(page.get_by_role("button", name="Copy")).to_be_visible()
    expect(page.locator("main")).not_to_contain_text("No sample has come")
    gateway.feed(score(1.0), health("learner", sequence=1))
    expect(panel).to_be_hidden()
    expect(page.locator(".fan.normal")).to_have_count(3)
    assert errors == []


@pytest.mark.usefixtures("quickly_hashed")
def test_an_operator_moves_the_fans_of_a_tray_without_a_twin_where_its_learner_allows_it(tmp_path, browser):
    errors: list[str] = []
    says, sweep = (
        ["step 5 of 46: command 0.2 for 1.0 s, 120 s left"],
        Sweep(plan="fan 0 of tray1: commands from 0.2 to 1"),
    )
    fans = (FanLearning(progress=0.3, missing="3 changes (10 needed)"), *[FanLearning(progress=1.0, missing="")] * 3)
    waits = Learning(tray=TRAY, what="4 of 10 minutes recorded", until_t_ns=0, helps="move them", fans=fans)
    sequence = count(1)

    def learner(now: Sweep | None) -> Health:
        return health("learner", sequence=next(sequence), learning=(replace(waits, sweep=now),))

    def answer(request: Request) -> list[Alarm]:
        """Answer as the learner does: by its health."""
        asked.append((request.action, request.operator_name))
        now = replace(sweep, asked_t_ns=request.t_ns)
        if request.action == Action.SWEEP:
            now = replace(now, running=says[0]) if says[0] else replace(now, ended="another tray is being swept: wait")
        else:
            now = replace(now, ended="stopped; the fans are left at these commands: fan 0 0.4")
        gateway.core.step(learner(now))
        return []

    asked: list[tuple[Action, str]] = []
    gateway = RunningGateway(tmp_path, answer, users=make_users(tmp_path / "users.toml"))
    try:
        gateway.feed(score(), learner(None))
        ann, vic = (opened(browser, f"http://127.0.0.1:{gateway.port}/", errors, name) for name in ("ann", "vic"))
        of_ann, of_vic = (page.get_by_role("region", name=f"Learning of {TRAY}") for page in (ann, vic))
        expect(of_ann).to_contain_text("sweep_on_request = true")
        expect(of_ann.get_by_role("button", name="Move the fans")).to_have_count(0)
        gateway.feed(learner(sweep))
        expect(of_vic).to_contain_text("vic may view but not act")
        ann.bring_to_front()
        of_ann.get_by_role("button", name="Move the fans").click()
        dialog = ann.get_by_role("dialog")
        expect(dialog).to_contain_text(sweep.plan)
        assert asked == []
        says[0] = ""
        dialog.get_by_role("button", name="Move the fans").click()
        expect(dialog).to_contain_text("another tray is being swept: wait")
        says[0] = "step 5 of 46: command 0.2 for 1.0 s, 120 s left"
        dialog.get_by_role("button", name="Move the fans").click()
        expect(dialog).to_be_hidden()
        for panel in (of_ann, of_vic):
            expect(panel).to_contain_text(f"The fans are moved: {says[0]}.")
        expect(of_vic.get_by_role("button")).to_have_count(0)
        assert inaccessible(ann) == []
        of_ann.get_by_role("button", name="Stop").click()
        expect(of_vic).to_contain_text("The last sweep: stopped; the fans are left")
        assert asked == [(action, "ann") for action in (Action.SWEEP, Action.SWEEP, Action.STOP_SWEEP)]
        ann.goto(f"http://127.0.0.1:{gateway.port}/#/fan/{TRAY}/1")
        expect(ann.locator(".fan-view")).to_contain_text(
            "Its twin is being learned: until then nothing judges this fan"
        )
        expect(ann.get_by_text("Service")).to_have_count(0)
        assert errors == []
    finally:
        gateway.close()


def test_a_thousand_fans_are_tiles_and_those_in_alarm_have_cards(tmp_path, browser):
    errors: list[str] = []
    fans = 1000
    running = RunningGateway(tmp_path, fans=fans)
    wide = {
        name: np.repeat(getattr(score(), name)[:, :1], fans, axis=1)
        for name in (
            "command",
            "measured_speed_rad_s",
            "predicted_speed_rad_s",
            "band_variance",
            "state",
            "valid",
            "invalid_reason",
            "torque_balance_command",
            "score",
            "statistic",
            "expected_residual_rad_s",
            "expected_balance_command",
        )
    }
    try:
        running.feed(replace(score(), fans=fans, **wide), replace(alarm(), fan=987))
        page = opened(browser, f"http://127.0.0.1:{running.port}/", errors)
        expect(page.locator(".tile")).to_have_count(fans)
        expect(page.get_by_role("button", name="● 999 normal", exact=True)).to_be_visible()
        card = page.locator(".fan")
        expect(card).to_contain_text("1,000 rpm")
        expect(card).to_contain_text("drag, 80 %")
        page.locator(".tile.normal").first.focus()
        page.keyboard.press("ArrowRight")
        assert page.evaluate("document.activeElement.ariaLabel") == f"{TRAY} fan 1 normal"
        assert "50 % of the alarm limit" in page.evaluate("document.activeElement.title")
        page.keyboard.press("Enter")
        expect(page.locator("h2").first).to_have_text("fan 1")
        assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    finally:
        running.close()
    assert errors == []


def test_the_history_has_one_row_a_fault_and_without_alarms_the_page_says_since_when(tmp_path, browser):
    errors: list[str] = []
    running = RunningGateway(tmp_path, started_t_ns=NOW_NS - 86_400 * 10**9)
    url = f"http://127.0.0.1:{running.port}/"
    try:
        running.feed(score())
        page = opened(browser, f"{url}#/alarms", errors)
        expect(page.locator("main")).to_contain_text("No alarm. None since")
        running.feed(
            alarm(),
            alarm(Transition.DIAGNOSED, 1, t_ns=NOW_NS + 5 * 10**9),
            alarm(Transition.CLEARED, 2, t_ns=NOW_NS + 60 * 10**9, active=False),
        )
        page.get_by_role("link", name="History").click()
        fault = page.locator("details.fault")
        expect(fault).to_have_count(1)
        expect(fault).to_contain_text("for 60 s")
        expect(fault.locator("li").first).to_be_hidden()
        fault.locator("summary").click()
        expect(fault.locator("li").first).to_be_visible()
        expect(fault.locator("li")).to_have_count(3)
    finally:
        running.close()
    assert errors == []


def test_the_browser_notifies_of_alarms_only_once_somebody_has_asked_for_it(gateway, browser):
    errors: list[str] = []
    gateway.feed(score())
    page = opened(browser, f"http://127.0.0.1:{gateway.port}/", errors)
    page.add_init_script(NOTIFICATIONS)
    page.reload()
    expect(page.locator("#connection")).to_contain_text("live")
    page.goto(page.url.split("#")[0] + "#/alarms")
    gateway.feed(alarm())
    expect(page.locator("article")).to_have_count(1)
    assert page.evaluate("window.notified") == []
    page.get_by_role("button", name="Notify me").click()
    expect(page.get_by_role("button", name="Notifications on")).to_be_visible()
    gateway.feed(replace(alarm(sequence=1, onset_t_ns=NOW_NS + 10**9), fan=1))
    expect(page.locator("article")).to_have_count(2)
    assert page.evaluate("window.notified") == [f"✖ {TRAY} fan 1: drag, 80 %"]
    assert errors == []
