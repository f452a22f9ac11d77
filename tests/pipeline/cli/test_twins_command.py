"""`fantwin twins`: what it prints for machines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fantwin.pipeline.learning.versions import Check, TwinVersions, learning_folder
from fantwin.schemas.units import NS_PER_S
from tests.support.fantwin_command import fantwin
from tests.support.learned_versions import DAY_NS, version


def printed(folder: Path) -> dict[str, Any]:
    config = folder / "fantwin.toml"
    config.write_text('[[tray]]\nname = "tray1"\nfans = 2\n', encoding="utf-8")
    found: dict[str, Any] = json.loads(fantwin("twins", "-c", config, "--json").stdout)
    return found


def test_no_reference_is_named_before_a_version_was_learned_from_24_hours(tmp_path: Path) -> None:
    versions = TwinVersions(learning_folder(tmp_path / "runs", "tray1"), "tray1")
    versions.add(version("tray1-1", 2, learned_spans=((DAY_NS, DAY_NS + 3600 * NS_PER_S),)))
    versions.add_check(Check(t_ns=2 * DAY_NS, reference="", change=(), found="", spans=()))
    before = printed(tmp_path)
    assert before["versions"][0]["reference"] is None
    assert before["check"]["reference"] is None
    versions.add(version("tray1-2", 3))
    versions.add(version("tray1-3", 4, reference="tray1-2"))
    versions.add_check(Check(t_ns=4 * DAY_NS, reference="tray1-2", change=(0.0, 0.0), found="", spans=()))
    after = printed(tmp_path)
    assert [each["reference"] for each in after["versions"]] == [None, "tray1-2", "tray1-2"]
    assert after["check"]["reference"] == "tray1-2"
    assert after["in_force"] == "tray1-3"
