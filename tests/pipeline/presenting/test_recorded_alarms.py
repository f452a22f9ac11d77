"""Alarms of recordings in the history of a gateway: how far back it is complete."""

from __future__ import annotations

from pathlib import Path

from pipeline.config.models import TrayConfig
from pipeline.presenting.alarm_store import AlarmStore
from pipeline.presenting.recorded_alarms import RecordedAlarms
from pipeline.presenting.site_model import SiteModel
from pipeline.recordings.writing import RecordingWriter
from schemas.topics import tray_key
from tests.pipeline.presenting.test_alarm_rates import FIRST, HOUR_NS, raised


def test_the_history_is_complete_from_where_the_recordings_of_all_shards_are(tmp_path: Path) -> None:
    recordings = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for hours, path in enumerate(recordings):
        with RecordingWriter(path, {}) as writer:
            alarm = raised(FIRST.first_t_ns + hours * HOUR_NS, hours)
            writer.add_message(tray_key("plant", "tray1", "alarm"), alarm, alarm.t_ns)
    store = AlarmStore(tmp_path / "alarms.sqlite")
    store.begins(FIRST.first_t_ns + 5 * HOUR_NS)  # the gateway's first start
    model = SiteModel("plant", [TrayConfig(name="tray1", fans=1, speed_unit="rpm")], store)
    recorded = RecordedAlarms(model, recordings)
    recorded._read()
    assert recorded.problem == ""
    assert [alarm.t_ns for _, alarm in store.newest(9)] == [FIRST.first_t_ns + HOUR_NS, FIRST.first_t_ns]
    assert model.history_begins_t_ns() == FIRST.first_t_ns + HOUR_NS
    model.close()
