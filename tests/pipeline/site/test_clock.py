"""What is silent, and which request has waited too long, goes by a clock that is passed in."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, wait

import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_desk import ANSWERED_WITHIN_S, MOST_UNDER_WAY, RequestDesk
from fantwin.pipeline.site.site_model import SILENT_AFTER_S, SiteModel
from fantwin.schemas.enums import Action
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Request
from fantwin.schemas.topics import tray_key
from tests.support.running_chain import DEADLINE_S
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.site_messages import alarm, score


class _Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> _Clock:
    return _Clock()


def test_the_bus_never_waits_for_a_disk_on_which_the_history_is_saved(tmp_path, clock, monkeypatch):
    saving, may_end = threading.Event(), threading.Event()
    store = AlarmHistory(tmp_path / "alarms.sqlite")
    monkeypatch.setattr(store, "add", lambda _alarm: (saving.set(), may_end.wait())[0])
    model = SiteModel(SITE, (TrayConfig(name=TRAY, fans=FANS),), store, now_s=clock)
    with ThreadPoolExecutor(2) as threads:
        threads.submit(model.add_alarm, alarm())
        saving.wait()
        asked = threads.submit(model.wants_score, TRAY, 1.0)
        is_wanted = wait([asked], timeout=DEADLINE_S).done
        may_end.set()
    assert is_wanted and asked.result()


def test_a_tray_without_a_score_is_silent_after_a_while_and_until_its_next_score(tmp_path, clock):
    trays = (TrayConfig(name=TRAY, fans=FANS, speed_unit="rpm"),)
    model = SiteModel(SITE, trays, AlarmHistory(tmp_path / "alarms.sqlite"), now_s=clock)
    envelope = Envelope.of(tray_key(SITE, TRAY, "score"), score(), 0)

    def is_shown() -> tuple[bool, bool]:
        model.notice_silence()
        return model.fan_now(Fan(TRAY, 0)).state == "silent", model.trays_now()[0].is_heard

    model.add_score(envelope)
    clock.now_s += SILENT_AFTER_S
    assert is_shown() == (False, True)
    clock.now_s += 0.1
    assert is_shown() == (True, False)
    model.add_score(envelope)
    assert is_shown() == (False, True)
    model.close()


def test_requests_without_an_answer_make_room_for_others_after_a_while(clock):
    desk, request = RequestDesk("gateway-all-1", clock), Request(t_ns=1, action=Action.ACKNOWLEDGE, fan=0)
    for _ in range(MOST_UNDER_WAY):
        desk.begin(TRAY, request, [0])
    assert len(desk.take()) == MOST_UNDER_WAY
    with pytest.raises(TimeoutError, match="waiting"):
        desk.begin(TRAY, request, [0])
    clock.now_s += ANSWERED_WITHIN_S + 0.1
    assert not desk.take()
    desk.begin(TRAY, request, [0]).cancel()
    desk.begin(TRAY, request, [1])
    assert len(desk.take()) == 1, "nobody waits for the first"
