"""`fantwin doctor selftest`: a promise that is not kept is a row and exit code 1; a scenario on a real site is kept."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
import tty
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.selftest import selftest
from fantwin.pipeline.selftest.scenarios import Scenario
from fantwin.pipeline.selftest.scratch_site import DisturbedLine, NotKept
from fantwin.pipeline.selftest.stepped_clock import set_offset_ns
from tests.support.fantwin_command import fantwin


class HealthySite:
    """A site that survives everything."""

    raised: list[object]
    status = 0

    def __init__(self, folder: Path, _device: object, *settings: str) -> None:
        self.folder, self.settings, self.raised = folder, settings, []

    def __enter__(self):
        return self

    def __exit__(self, *_error: object) -> None:
        return

    def seconds_until_judged(self) -> float:
        return 0.1

    def stop(self) -> tuple[int, dict[str, Any]]:
        return self.status, {"lost": {"resampler": 2}}

    def last_line(self) -> str:
        return "the last line"

    def recordings(self) -> list[Path]:
        return []

    def command(self, *_words: object, limit_s: float):
        return type("Done", (), {"returncode": 0, "stdout": "equal: 5 samples\n", "stderr": ""})


class BlindSite(HealthySite):
    def seconds_until_judged(self) -> float:
        raise NotKept("judging did not go on within 60 s")


class BadlyEndedSite(HealthySite):
    status = 1


class EndlessSite(HealthySite):
    def stop(self) -> tuple[int, dict[str, Any]]:
        raise NotKept("it did not stop")


def refuses(_site: object) -> str:
    raise NotKept("it ended")


def alarms(site: HealthySite) -> str:
    site.raised.append("alarm")
    return "seen"


FINE = Scenario("fine", "nothing happens", lambda _site: "seen")


def rows_of(monkeypatch: pytest.MonkeyPatch, folder: Path, site: type, *scenarios: Scenario) -> list[selftest.Row]:
    monkeypatch.setattr(selftest, "ScratchSite", site)
    return list(selftest.run_scenarios(folder, scenarios, lambda: None))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("site", "run", "seen"),
    [
        (HealthySite, refuses, "it ended"),
        (HealthySite, alarms, "seen; but 1 healthy fans raised an alarm"),
        (BlindSite, FINE.run, "seen; but judging did not go on within 60 s"),
    ],
)
def test_a_promise_that_is_not_kept_is_a_row_that_says_what_was_seen(monkeypatch, tmp_path, site, run, seen):
    row, account = rows_of(monkeypatch, tmp_path, site, Scenario("bad", "promised", run))
    assert (row.kept, row.seen) == (False, seen)
    assert (account.kept, account.seen) == (True, "lost: resampler 2; equal: 5 samples")


@pytest.mark.parametrize(
    ("site", "seen"), [(BadlyEndedSite, "exit code 1: the last line"), (EndlessSite, "it did not stop")]
)
def test_a_site_that_ends_badly_is_a_row_that_says_how(monkeypatch, tmp_path, site, seen):
    row, account = rows_of(monkeypatch, tmp_path, site, FINE)
    assert (row.kept, account.kept, account.seen) == (True, False, seen)


def test_scenarios_share_a_site_unless_they_need_their_own(monkeypatch, tmp_path):
    alone = Scenario("alone", "promised", FINE.run, needs_own_site=True)
    rows = rows_of(monkeypatch, tmp_path, HealthySite, FINE, alone, FINE)
    names = ["fine", "fine", "shutdown after fine, fine", "alone", "shutdown after alone"]
    assert [row.name for row in rows] == names


def test_without_the_right_to_mount_a_disk_a_scenario_is_not_run_and_nothing_fails(monkeypatch, tmp_path):
    monkeypatch.setattr(selftest.shutil, "which", lambda _name: None)
    (row,) = rows_of(monkeypatch, tmp_path, HealthySite, Scenario("disk", "promised", refuses, needs_small_disk=True))
    assert (row.kept, row.seen) == (None, "not run: only root may mount a small disk")


def test_the_exit_code_says_whether_all_promises_were_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(selftest, "ScratchSite", HealthySite)
    codes = {}
    for name, scenario in (("kept", FINE), ("not-kept", Scenario("bad", "promised", refuses))):
        monkeypatch.setattr("fantwin.pipeline.cli.watch.selftest.SCENARIOS", [scenario])
        done = fantwin("doctor", "selftest", "--json", "-o", tmp_path / name)
        codes[name] = (done.exit_code, json.loads(done.stdout)["kept"])
    assert codes == {"kept": (0, True), "not-kept": (1, False)}


def test_the_clock_of_a_process_follows_the_file(tmp_path):
    clock = tmp_path / "clock"
    set_offset_ns(clock, -3600 * 10**9)
    code = "from fantwin.pipeline.selftest.stepped_clock import install; install(); import time; print(time.time_ns())"
    environment = {**os.environ, "FANTWIN_SELFTEST_CLOCK": str(clock)}
    before_ns = time.time_ns()
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert before_ns <= int(done.stdout) + 3600 * 10**9 <= time.time_ns()


def test_a_line_loses_what_is_sent_while_it_is_cut_and_delivers_what_it_held_in_order(tmp_path):
    line = DisturbedLine(tmp_path / "port")
    assert not line.write(b"nobody reads")
    reader = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY)
    tty.setraw(reader)
    noise = bytes(range(256)) * 100
    line.is_cut = True
    line.write(b"lost")
    line.is_cut, line.is_held = False, True
    for number in range(5):
        line.write(bytes([number]) * 700)
    assert not select.select([reader], [], [], 0)[0]
    line.is_held = False
    line.inject(noise)
    sent = b"".join(bytes([number]) * 700 for number in range(5)) + noise
    got = b""
    while len(got) < len(sent):
        line.write(b"!")
        got += os.read(reader, 4096)
    os.close(reader)
    line.close()
    assert got[: len(sent)] == sent


@pytest.mark.real_time
def test_on_a_real_site_noise_is_skipped_and_its_recording_verifies():
    done = fantwin("doctor", "selftest", "noise", "--json")
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["rows"]
    assert [row["name"] for row in rows] == ["noise", "shutdown after noise"]
