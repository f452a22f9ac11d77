"""Which files are parts of one recording."""

from __future__ import annotations

import json
from pathlib import Path

from fantwin.pipeline.recordings.run_recordings import describe, recordings_of
from fantwin.pipeline.recordings.writing import RecordingWriter

ANOTHER_PLACE = ["gateway.port=8081", 'launcher.without=["viewer"]', "viewer={}", "run_folder='x'", "bus.endpoint='y'"]


def file(path: Path, **metadata: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path, {"site": "plant", **metadata}, {"configuration.toml": b"site = 'plant'"}):
        return path


def test_parts_are_found_by_session_or_by_name_in_one_folder_and_nothing_else_is_a_part(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    first = file(here / "day.mcap", recording="day.mcap", session="s1")
    restarted = file(here / "day-2.mcap", recording="day.mcap", session="s2")
    at_a_port = file(here / "day-4.mcap", recording="day.mcap", overrides=json.dumps(ANOTHER_PLACE))
    deciding = file(here / "day-5.mcap", recording="day.mcap", overrides='["scorer.alarm_share=1"]')
    moved = file(there / "day-3.mcap", recording="day.mcap", session="s2")
    of_another_tray = file(tmp_path / "elsewhere" / "day.mcap", recording="day.mcap", session="s9")
    of_another_site = file(here / "day-9.mcap", recording="day.mcap", session="s1", site="other")
    imported = [file(here / name, source="table.csv") for name in ("table.mcap", "table-2.mcap")]
    files = (moved, first, imported[0], of_another_tray, restarted, imported[1], of_another_site)
    files = (*files, at_a_port, deciding)
    assert recordings_of(map(describe, files)) == [
        (moved, first, restarted, at_a_port), (imported[0],), (of_another_tray,), (imported[1],), (of_another_site,),
        (deciding,),
    ]  # fmt: skip
