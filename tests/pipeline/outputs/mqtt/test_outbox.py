"""What waits for the broker: one text a topic, urgent ones first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.fan_states import FanStates
from fantwin.pipeline.outputs.mqtt.outbox import READER, Outbox, Outgoing, TransitionQueue
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import FanState
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Score
from fantwin.schemas.topics import tray_key
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.site_messages import alarm, score


def texts(outbox: Outbox, most: int = 100) -> list[str]:
    return [f"{message.topic} {message.text}" for message in outbox.take(most)]


def test_only_the_newest_text_of_a_topic_is_sent_and_urgent_ones_first():
    outbox = Outbox()
    for text in "123":
        outbox.retain("a", text)
        outbox.retain("b", text)
    outbox.retain("c", "1", is_urgent=True)
    outbox.retain("b", "4", is_urgent=True)
    outbox.answer("d", "1")
    assert texts(outbox, 2) == ["c 1", "b 4"]
    assert texts(outbox) == ["d 1", "a 3"]
    outbox.retain("a", "3")
    assert texts(outbox) == [], "it has not changed"


def test_after_a_new_connection_all_that_is_retained_is_sent_again():
    outbox = Outbox()
    outbox.retain("a", "1")
    outbox.answer("c", "1")
    outbox.take(100)
    outbox.renew()
    assert outbox.take(100) == [Outgoing("a", "1", is_retained=True)]


def test_the_state_of_a_fan_is_published_again_only_when_it_has_changed(tmp_path):
    trays = (TrayConfig(name=TRAY, fans=FANS),)
    model = SiteModel(SITE, trays, AlarmHistory(tmp_path / "alarms.sqlite"))
    states = FanStates(model)

    def changed(made: Score, *, is_full: bool = False) -> list[int]:
        model.add_score(Envelope.of(tray_key(SITE, TRAY, "score"), made, 0))
        return [fan.number for fan in states.changed(is_full=is_full, with_silent=False)]

    assert changed(score()) == list(range(FANS))
    assert changed(score(1.0), is_full=True) == []
    assert changed(score(2.0, state=FanState.SUSPECT)) == [2]
    faster = replace(score(3.0, state=FanState.SUSPECT), measured_speed_rad_s=np.full((5, FANS), 200.0))
    assert changed(faster) == [], "a number alone waits for the period"
    assert len(changed(replace(faster, t_ns=faster.t_ns + 1), is_full=True)) == FANS


def filled(folder: Path, count: int) -> AlarmHistory:
    store = AlarmHistory(folder / "alarms.sqlite")
    store.set_position(READER, 0)
    for number in range(count):
        store.add(alarm(sequence=number))
    return store


def test_transitions_are_done_without_a_gap_only(tmp_path):
    store = filled(tmp_path, 5)
    queue = TransitionQueue(store, 100)
    assert [number for number, _ in queue.take(3)] == [1, 2, 3]
    queue.acknowledge(3)
    queue.acknowledge(2)
    assert queue.waiting == 5
    again = TransitionQueue(store, 100)
    assert [number for number, _ in again.take(9)] == [1, 2, 3, 4, 5], "after a crash all that may be missing"
    queue.acknowledge(1)
    assert queue.waiting == 2
    assert [number for number, _ in TransitionQueue(store, 100).take(9)] == [4, 5]
    queue.acknowledge(77)
    assert [number for number, _ in queue.take(9)] == [4, 5]
