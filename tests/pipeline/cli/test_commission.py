"""`fantwin commission`: which commands run on which recordings, what one failed tray changes, what it refuses.

The commands and the recording site are played; whole runs are in tests/system.
"""

from __future__ import annotations

import json
import re
import shutil
import threading
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest
from typer.testing import Result

from fantwin.pipeline.cli.watch import commission, commission_state, commissioning
from fantwin.pipeline.cli.watch.child_commands import Commands, Stopped, next_recording_file
from fantwin.pipeline.cli.watch.commission_state import RECORDING_ONLY
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.training_data import Part
from fantwin.pipeline.recordings.disk_room import DAY_NS, DiskRoom
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from tests.support.fantwin_command import as_typed, fantwin
from tests.support.made_messages import filled
from tests.support.replay_data import START_NS, raw_of
from tests.support.running_chain import DEMO

LEVELS = (0.2, 0.5, 0.7, 0.95)
HELD_S = 25


class PlayedSite:
    """A line on which the trays send two samples a second, in simulated time."""

    now_s = 0.0
    still: Sequence[str] = ()
    """trays whose commands stay"""
    count = 0

    def __init__(self, _commands: Commands, config: Any, _words: list[str], _log: Path, trays: Sequence[TrayConfig]):
        self.trays = trays
        self.lost: dict[str, int] = {}
        self.recordings: list[Path] = []
        self.folder = config.run_folder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        PlayedSite.count += 1
        path = self.folder / f"{PlayedSite.count}.mcap"
        with RecordingWriter(path, {"trays": "a,b", "speed_unit": "rpm"}, t_ns=START_NS) as writer:
            for tray in ("a", "b"):
                writer.add_message(tray_key("site", tray, "raw"), raw_of(0, 1, tray=tray, samples=50), START_NS)
        self.recordings = [path]

    def wait_for_samples(self) -> None:
        pass

    def wait(self, seconds: float) -> list[Raw]:
        PlayedSite.now_s += seconds
        return [self.sample(tray.name) for tray in self.trays]

    def silence_of(self, _tray: str) -> str:
        return ""

    def sample(self, tray: str) -> Raw:
        level = 0.5 if tray in self.still else LEVELS[int(self.now_s // HELD_S) % len(LEVELS)]
        t_ns = np.array([self.now_s - 0.5, self.now_s]) * NS_PER_S
        columns = {"host_receive_t_ns": t_ns, "command": level, "speed_rad_s": 900 * level}
        return filled(Raw, 2, 1, header=Header("acquisition", 0, tray), **columns)


class Played:
    """The commands that were run, and which of them fail."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = folder / "fantwin.toml"
        self.lines: list[str] = []
        self.failing: tuple[str, str] = ("", "")
        """command and tray"""
        self.stopped: tuple[str, str] = ("", "")
        """the same, of the one during which its user stops"""
        self.spared = 0
        """so many of these come to their end"""

    def run(self, *words: object, site: PlayedSite | None = None, as_messages: bool = False) -> None:
        assert as_messages is (words[0] == "doctor")
        line = [str(word).replace(f"{self.folder}/", "") for word in words]
        self.lines.append(" ".join(line))
        here = line[0], _after("--tray", line)
        if here in (self.stopped, self.failing) and self.spared:
            self.spared -= 1
            return
        if here == self.stopped:
            raise Stopped
        if here == self.failing:
            raise UserError(f"`fantwin {line[0]}` failed (exit code 1) and has said why")
        if line[0] == "train":
            shutil.copy(DEMO / "twin.onnx", self.folder / _after("-o", line))

    def commission(self, *words: object) -> Result:
        return fantwin("commission", "-c", self.configuration, "--minutes", 1, "--no-watch", *words)

    def of(self, name: str) -> list[str]:
        """The lines of a command, without its name and the configuration."""
        return [line.removeprefix(name).replace(" -c fantwin.toml", "") for line in self.lines if line.startswith(name)]


def _after(option: str, line: list[str]) -> str:
    return next((word for before, word in pairwise(line) if before == option), "")


@pytest.fixture
def played(tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Played:
    played = Played(tmp_path)
    text = f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n'
    for tray in ("a", "b"):
        text += f'[[tray]]  # {tray}, upper shelf\nname = "{tray}"\nfans = 1\nport = "{tray}"\n'
    played.configuration.write_text(text, encoding="utf-8")
    for name, value in (("now_s", 0.0), ("count", 0), ("still", ())):
        monkeypatch.setattr(PlayedSite, name, value)
    monkeypatch.setattr(commission, "stop_on_signals", threading.Event)  # this process has its own
    monkeypatch.setattr(commissioning, "RecordingSite", PlayedSite)
    monkeypatch.setattr(commissioning, "time", SimpleNamespace(monotonic=lambda: PlayedSite.now_s))
    monkeypatch.setattr(Commands, "run", played.run)
    return played


def with_twins(text: str, *trays: str) -> str:
    for tray in trays:
        text = text.replace(f"# {tray}, upper shelf\n", f'# {tray}, upper shelf\ntwin = "{tray}.onnx"\n')
    return text


def test_each_tray_gets_a_twin_of_its_own_samples_in_its_own_section(played: Played) -> None:
    before = played.configuration.read_text(encoding="utf-8")
    result = played.commission()
    assert not result.exception, result.output
    assert played.configuration.read_text(encoding="utf-8") == with_twins(before, "a", "b")
    (doctor,) = played.of("doctor")
    assert "--tray" not in doctor
    assert played.of("train") == [f" runs/1.mcap --validate runs/2.mcap --tray {tray} -o {tray}.onnx" for tray in "ab"]
    rate = "--false-alarms-per-day 1 --extrapolate"
    assert played.of("calibrate") == [f" {tray}.onnx runs/2.mcap runs/3.mcap --tray {tray} {rate}" for tray in "ab"]
    assert 'tray b has twin = "b.onnx" now' in result.output


def test_one_tray_after_the_other_is_swept_into_recordings_of_its_own(played: Played) -> None:
    result = played.commission("--sweep", "--low", 0.3)
    assert not result.exception, result.output
    assert played.of("command") == [
        f" --sweep --tray {tray} --low 0.3 --rounds {rounds}" for tray in "ab" for rounds in (2, 1)
    ]
    assert result.output.startswith(
        "plan: of each tray a sweep of 2 rounds to train on and one of 1 round to validate; "
    )
    assert "tray a: the second sweep, 1 round, to validate" in result.output
    assert played.of("train") == [
        " runs/1.mcap --validate runs/2.mcap --tray a -o a.onnx",
        " runs/3.mcap --validate runs/4.mcap --tray b -o b.onnx",
    ]
    assert [line.partition(" --tray")[0] for line in played.of("calibrate")] == [
        " a.onnx runs/2.mcap runs/5.mcap",
        " b.onnx runs/4.mcap runs/5.mcap",
    ]


def test_it_waits_for_the_fans_of_every_tray_and_says_which_have_not_moved(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PlayedSite, "still", ("b",))
    monkeypatch.setattr(commissioning, "AT_MOST_S", 1800.0)
    result = played.commission("--json")
    lines = result.stderr.splitlines()
    both = r"1 min of at least 1; still missing: tray a, fan 0: .*; tray b, fan 0: command 0\.5 so far, .*"
    assert any(re.fullmatch(both, line) for line in lines), lines
    alone = r"10 min of at least 1; still missing: tray b, fan 0: [^;]*"
    assert any(re.fullmatch(alone, line) for line in lines), lines
    failed = "tray b failed: in 0.5 h its fans have not moved enough (fan 0: command 0.5 so far, "
    assert [line.endswith("; going on without it") for line in lines if line.startswith(failed)] == [True]
    assert str(result.exception).startswith(failed)
    assert [line.split()[-3] for line in played.of("train")] == ["a"]
    assert (played.folder / "a.onnx").exists()


@pytest.mark.parametrize("command", ["train", "calibrate", "command"])
def test_a_tray_that_fails_leaves_the_others_their_twins(played: Played, command: str) -> None:
    before = played.configuration.read_text(encoding="utf-8")
    played.failing = (command, "a")
    result = played.commission("--sweep", "--json")
    assert isinstance(result.exception, UserError)
    recorded = ", ".join(str(played.folder / "runs" / f"{number}.mcap") for number in range(1, PlayedSite.count + 1))
    reason = f"`fantwin {command}` failed (exit code 1) and has said why"
    assert str(result.exception) == f"tray a failed: {reason}; recorded: {recorded}"
    assert played.configuration.read_text(encoding="utf-8") == with_twins(before, "b")
    assert [path.name for path in played.folder.glob("*.onnx")] == ["b.onnx"]
    found = json.loads(result.stdout)
    assert found["failed"] == {"a": reason}
    assert [(each["tray"], each["entry"]) for each in found["trays"]] == [("b", "b.onnx")]
    assert found["recordings"] == recorded.split(", ")


def test_ctrl_c_keeps_the_twins_that_were_written(played: Played) -> None:
    before = played.configuration.read_text(encoding="utf-8")
    played.stopped = ("calibrate", "b")
    result = played.commission()
    assert result.exit_code == 130
    assert "interrupted: twins were written of tray a only; recorded until then: " in result.stderr
    assert played.configuration.read_text(encoding="utf-8") == with_twins(before, "a")
    assert [path.name for path in played.folder.glob("*.onnx")] == ["a.onnx"]


def test_what_was_recorded_before_an_early_end_is_used_by_the_same_command(played: Played) -> None:
    played.failing, played.spared = ("command", "b"), 1
    broken = str(played.commission("--sweep").exception)
    assert broken.startswith("tray b failed: ")
    assert broken.endswith("; the same command goes on after the recordings that are complete")
    played.failing, played.stopped = ("", ""), ("train", "b")
    played.lines.clear()
    interrupted = played.commission("--sweep")
    assert interrupted.exit_code == 130
    assert "tray b: training data were recorded in the last day" in interrupted.output
    assert played.of("command") == [" --sweep --tray b --rounds 1"], "what was left to do"
    played.stopped = ("", "")
    played.lines.clear()
    assert not played.commission("--sweep").exception
    assert not played.of("command")
    assert played.of("train") == [" runs/3.mcap --validate runs/6.mcap --tray b -o b.onnx"]
    assert not (played.folder / "runs" / "commission.json").exists()


@pytest.mark.parametrize("change", ["", "options", "age", "file", "twin"])
def test_what_other_options_made_or_is_old_or_gone_or_made_no_twin_is_recorded_again(
    played: Played, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    setattr(played, "failing" if change == "twin" else "stopped", ("train", "a"))
    played.commission("--tray", "a", "--minutes", 2)
    played.failing = played.stopped = ("", "")
    if change == "age":
        monkeypatch.setattr(commission_state, "time", SimpleNamespace(time=lambda: time.time() + 86_401))
    if change == "file":
        (played.folder / "runs" / "2.mcap").unlink()
    done = played.commission("--tray", "a", "--minutes", 3 if change == "options" else 2)
    assert not done.exception, done.output
    first = 4 if change else 1
    trained = f" runs/{first}.mcap --validate runs/{first + 1}.mcap --tray a -o a.onnx"
    assert played.of("train")[-1] == trained


def test_two_of_them_do_not_mix_their_recordings(played: Played) -> None:
    with commission_state.Unfinished(played.folder / "runs"):
        refused = str(played.commission().exception)
    assert refused.startswith("another `fantwin commission` runs with run folder ") and not played.lines


def test_a_tray_that_names_a_twin_keeps_it(played: Played) -> None:
    text = with_twins(played.configuration.read_text(encoding="utf-8"), "a").replace("a.onnx", "old.onnx")
    played.configuration.write_text(text, encoding="utf-8")
    result = played.commission()
    assert not result.exception, result.output
    assert result.output.splitlines()[0] == f"{played.configuration}: tray a keeps its twin old.onnx"
    assert played.configuration.read_text(encoding="utf-8") == with_twins(text, "b")
    assert played.of("train") == [" runs/1.mcap --validate runs/2.mcap --tray b -o b.onnx"]


def test_only_the_chosen_tray_gets_a_twin_under_the_chosen_name(played: Played) -> None:
    before = played.configuration.read_text(encoding="utf-8")
    twin = played.folder / "twin.onnx"
    result = played.commission("--tray", "b", "-o", twin)
    assert not result.exception, result.output
    assert played.configuration.read_text(encoding="utf-8") == with_twins(before, "b").replace("b.onnx", "twin.onnx")
    assert [path.name for path in played.folder.glob("*.onnx")] == ["twin.onnx"]
    (doctor,) = played.of("doctor")
    assert doctor.endswith(" --tray b"), "the line of the other tray may not be connected"


def test_a_wrong_tacho_of_a_tray_is_found_before_it_is_swept_again(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(_recordings: object, part: Part, _each: object) -> SimpleNamespace:
        return SimpleNamespace(hints=("fan 0: counts over 0.5 s",) if part.tray == "a" else ())

    monkeypatch.setattr(commissioning, "read_training_data", read)
    result = played.commission("--sweep")
    failed = "tray a failed: fan 0: counts over 0.5 s: declare the tacho that was found, then start again"
    assert str(result.exception).startswith(failed)
    assert [line.split()[2] for line in played.of("command")] == ["a", "b", "b"]
    assert (played.folder / "b.onnx").exists()


def test_why_its_doctor_step_fails_is_on_standard_error(
    tmp_path: Path, endpoint: str, capfd: pytest.CaptureFixture[str]
) -> None:
    configuration = tmp_path / "fantwin.toml"
    text = f'[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "tray1"\nfans = 1\nport = "none"\n'
    configuration.write_text(text, encoding="utf-8")
    done = as_typed("commission", "-c", configuration)
    assert done.returncode == 1
    assert "FIX  acquisition/tray1: " in capfd.readouterr().err, "of the child"
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
