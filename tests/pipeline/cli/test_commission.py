"""`fantwin commission`: what it refuses, and what it leaves on the disk. Whole runs: tests/system."""

from __future__ import annotations

from pathlib import Path

from fantwin.pipeline.cli.watch.child_commands import RECORDING_ONLY, next_recording_file
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.recordings.disk_room import DAY_NS, DiskRoom
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from tests.support.fantwin_command import as_typed


def test_why_its_doctor_step_fails_is_on_standard_error(tmp_path: Path, endpoint: str) -> None:
    configuration = tmp_path / "fantwin.toml"
    text = f'[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "tray1"\nfans = 1\nport = "none"\n'
    configuration.write_text(text, encoding="utf-8")
    done = as_typed("commission", "-c", configuration)
    assert done.returncode == 1
    assert "FIX  acquisition/tray1: " in done.stderr
    assert done.stderr.rstrip().endswith("fantwin: `fantwin doctor` failed (exit code 1) and has said why")
    (line,) = done.stdout.splitlines()
    assert line.startswith("fantwin doctor -c ")


def test_a_site_that_only_records_records_whatever_its_configuration_leaves_out(tmp_path: Path) -> None:
    configuration = tmp_path / "fantwin.toml"
    text = '[[tray]]\nname = "tray1"\nfans = 1\nport = "line"\n[launcher]\nwithout = ["recorder", "viewer"]\n'
    configuration.write_text(text, encoding="utf-8")
    site = load_config(configuration, RECORDING_ONLY[1::2])
    assert site.stages == ("acquisition", "resampler", "recorder")


def test_no_limit_of_a_later_recorder_deletes_what_twins_are_made_of(tmp_path: Path) -> None:
    configuration = tmp_path / "fantwin.toml"
    text = '[[tray]]\nname = "tray1"\nfans = 1\nport = "line"\n[recorder]\nfile = "disk/recording.mcap"\n'
    configuration.write_text(text, encoding="utf-8")
    config = load_config(configuration, stages=("recorder",))

    def recorded(file: Path) -> Path:
        """One part, a day after the start of 1970."""
        parts = RecordingParts(config.run_folder / file, {}, {}, session="one")
        part = parts.begin(DAY_NS, SequenceLedger(), {})
        part.finish()
        return part.path

    ordinary, last = (recorded(Path("disk/recording.mcap")) for _ in range(2))
    for_twins = [recorded(next_recording_file(config)) for _ in range(2)]
    limits = RecorderConfig(keep_days=1)
    for file in (Path("disk/recording.mcap"), next_recording_file(config)):
        DiskRoom(RecordingParts(config.run_folder / file, {}, {}, session="two"), limits).keep_limits(10 * DAY_NS)
    assert last.exists() and not ordinary.exists(), "the last part of a folder stays"
    assert for_twins == [config.run_folder / f"disk/commissioned-{n}/commissioned-{n}.mcap" for n in (1, 2)]
    assert all(path.exists() for path in for_twins)
