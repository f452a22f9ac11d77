"""`fantwin commission`: what it refuses, and when a plant has moved its fans enough. Whole runs: tests/system."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fantwin.pipeline.cli.watch.child_commands import RECORDING_ONLY, next_recording_file
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.recordings.disk_room import DAY_NS, DiskRoom
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S
from tests.support.running_chain import fantwin

TRAY = TrayConfig.model_validate({"name": "tray1", "fans": 2, "command_max": 100.0})


def samples(commands: np.ndarray, first_s: float = 0.0, period_s: float = 0.5) -> Raw:
    """Of two fans; commands: (n, 2)."""
    n = len(commands)
    t_ns = ((first_s + period_s * np.arange(n)) * NS_PER_S).astype(np.int64)
    return Raw(
        fans=2,
        host_receive_t_ns=t_ns,
        device_clock_us=np.zeros(n, np.uint32),
        device_sequence=np.arange(n, dtype=np.uint32),
        command=commands,
        speed_rad_s=np.ones((n, 2)),
    )


def stairs(levels: list[float], held: int = 50) -> np.ndarray:
    """Two fans, of which the second holds the first level."""
    moved = np.repeat(levels, held)
    return np.column_stack((moved, np.full(len(moved), levels[0])))


def test_a_fan_has_moved_enough_after_enough_levels_and_changes_and_the_others_are_named() -> None:
    operation = OrdinaryOperation(TRAY)
    assert (
        operation.missing()[0]
        == "fan 0: no command yet, 20 s each in 0 tenths of 0 to 100 (4 needed), 0 changes (10 needed)"
    )
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0, 45.0])))
    first, second = operation.missing()
    assert first == "fan 0: commands 20 to 95, 20 s each in 4 tenths of 0 to 100 (4 needed), 5 changes (10 needed)"
    assert second == "fan 1: command 20, 20 s each in 1 tenths of 0 to 100 (4 needed), 0 changes (10 needed)"
    operation.take(samples(stairs([20.0, 45.0, 70.0, 95.0, 20.0]), first_s=150.0))
    (left,) = operation.missing()
    assert left.startswith("fan 1:")
    assert operation.held() == ["fan 1: command 20"]


def test_a_command_that_flickers_between_two_ranges_does_not_change_and_gaps_do_not_count() -> None:
    operation = OrdinaryOperation(TRAY)
    flickers = np.where(np.arange(400) % 2 == 0, 29.9, 30.1)
    operation.take(samples(np.column_stack((flickers, flickers))))
    assert operation.held() == ["fan 0: commands 29.9 to 30.1", "fan 1: commands 29.9 to 30.1"]
    sparse = OrdinaryOperation(TRAY)
    sparse.take(samples(stairs([20.0, 45.0], held=10), period_s=10.0))
    assert (
        sparse.missing()[0]
        == "fan 0: commands 20 to 45, 20 s each in 0 tenths of 0 to 100 (4 needed), 1 changes (10 needed)"
    )


def test_why_its_doctor_step_fails_is_on_standard_error(tmp_path: Path, endpoint: str) -> None:
    configuration = tmp_path / "fantwin.toml"
    text = f'[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "tray1"\nfans = 1\nport = "none"\n'
    configuration.write_text(text, encoding="utf-8")
    done = fantwin("commission", "-c", configuration)
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
        DiskRoom(RecordingParts(config.run_folder / file, {}, {}, session="two"), limits, None).keep_limits(10 * DAY_NS)
    assert last.exists() and not ordinary.exists(), "the last part of a folder stays"
    assert for_twins == [config.run_folder / f"disk/commissioned-{n}/commissioned-{n}.mcap" for n in (1, 2)]
    assert all(path.exists() for path in for_twins)
