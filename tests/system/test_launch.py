"""`fantwin up` as processes: however it ends, all that was sent is recorded and scored."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable

import numpy as np
import pytest
from mcap.reader import make_reader

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.loss_accounting import label
from fantwin.schemas.codec import decode
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key
from tests.support.fantwin_command import as_typed
from tests.support.running_chain import (
    DEADLINE_S,
    FANS,
    SITE,
    TRAY,
    Chain,
    RunningCommand,
    eventually,
    is_running,
    published,
    view_of,
)
from tests.support.twin_files import write_twin

pytestmark = [pytest.mark.slow, pytest.mark.real_time]
MANY = 50  # messages of scores: the chain has come to run evenly


@pytest.fixture
def chain(new_chain: Callable[..., Chain]) -> Chain:
    return new_chain()


def start(chain: Chain) -> RunningCommand:
    """The tray and all stages; scores flow."""
    chain.start_tray()
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > MANY, "scores flow")
    return up


def samples(chain: Chain, topic: str, column: str) -> set[int]:
    """The values of a column of samples in all parts of the recording, including an unfinished one."""
    return {
        int(value)
        for path in chain.folder.glob("recording*.mcap*")
        for entry in read_recording(path, topics=(topic,))
        for value in getattr(entry.message, column)
    }


def check_whole(chain: Chain, sent_before_the_end: int) -> None:
    """The recordings are complete for a plain MCAP reader and hold all sent messages, scored to the end."""
    assert not list(chain.folder.glob("*.active"))
    for recording in chain.recordings():
        with recording.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary and summary.statistics
        topics = {channel.topic for channel in summary.channels.values()}
        assert {tray_key(SITE, TRAY, name) for name in ("raw", "grid", "prediction", "score", "twin")} <= topics
    grid, prediction, score = (samples(chain, topic, "t_ns") for topic in ("grid", "prediction", "score"))
    assert grid == prediction == score
    assert len(score) > MANY
    # what the tray sends between the last read and the closing of the port goes with the port, and is not meant
    recorded = samples(chain, "raw", "device_sequence")
    assert recorded == set(range(len(recorded)))
    assert chain.tray
    assert sent_before_the_end <= len(recorded) <= chain.tray.output()["samples_sent"]


def command_reaches_the_fan(chain: Chain) -> int:
    """Returns how many samples the tray had sent by then."""
    newest: dict[str, np.ndarray] = {}

    def keep(_key: str, payload: bytes) -> None:
        message = decode(Raw, payload)
        assert isinstance(message, Raw)
        newest["command"] = message.command[-1]
        newest["sequence"] = message.device_sequence[-1:]

    with Bus(BusConfig(endpoint=chain.endpoint), listens=False) as bus:
        bus.subscribe(tray_key(SITE, TRAY, "raw"), keep)
        done = as_typed(*chain.words("command"), "--fan", 3, 0.625, "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout) == {
            **{"tray": TRAY, "fan": 3, "name": "", "kind": "command"},
            **{"value": 0.625, "unit": ""},
        }
        eventually(lambda: "command" in newest and newest["command"][3] == 0.625, "fan 3 has its command")
        assert np.count_nonzero(newest["command"] == 0.625) == 1
        return int(newest["sequence"][0]) + 1


def test_row_08_visitors_and_a_closed_terminal_lose_nothing_and_ctrl_c_stops_in_order(chain):
    """Also with a recorder that is down at the end: it is started again to record what it has missed."""
    up = start(chain)
    sent_before_the_end = command_reaches_the_fan(chain)
    up.process.send_signal(signal.SIGHUP)  # as when the terminal is closed
    recorder = chain.process_ids()["recorder"]
    up.process.send_signal(signal.SIGSTOP)  # it learns of the kill and of its own end together
    os.kill(recorder, signal.SIGKILL)
    eventually(lambda: not is_running(recorder), "it is dead")
    up.process.send_signal(signal.SIGINT)  # while the tray is sending
    status = up.end(signal.SIGCONT)
    assert chain.tray and chain.tray.end() == 0
    assert status == 0, up.lines
    outcome = up.output()
    assert [f"resampler, {TRAY}"] == [note.partition(":")[0] for note in outcome.pop("notes") if " Hz" in note]
    assert outcome.pop("restarts") in ({}, {"recorder": 1}), "the death or the signal is seen first"
    assert outcome == {
        "run_folder": str(chain.folder),
        "recordings": [str(chain.folder / name) for name in ("recording.mcap", "recording-2.mcap")],
        "killed": [],
        "failed": [],
        "lost": dict.fromkeys(sorted(chain.stages), 0),
        "refused": {},
        "unusable": [],
    }
    assert not any(map(is_running, chain.process_ids().values()))
    check_whole(chain, sent_before_the_end)


def test_without_their_launcher_all_stages_end_in_order_and_leave_a_whole_recording(chain):
    up = start(chain)
    with chain.watcher() as watcher:
        children = chain.process_ids()

        def say() -> dict[str, str]:
            return {label(view.health): view.health.status.name for view in watcher.stages()}

        # peers meet through the launcher: without it this watcher would not hear those it has not met
        chain.eventually(watcher, lambda: say() == dict.fromkeys(chain.stages, "OK"), "the watcher hears all stages")
        up.process.kill()
        chain.eventually(watcher, lambda: not any(map(is_running, children.values())), "all stages have ended")
        # what the last one has sent may still be on its way
        chain.eventually(watcher, lambda: say() == dict.fromkeys(chain.stages, "STOPPED"), "all say that they end")
        assert not any(watcher.losses().values())
    assert chain.tray and chain.tray.end() == 0
    check_whole(chain, MANY)


def test_a_stage_that_cannot_start_ends_all_with_one_line(tmp_path, new_chain):
    twin = write_twin(tmp_path / "twin.onnx", fans=FANS, calibration={"speed": "none"})
    chain = new_chain(f"tray.0.twin='{twin}'", stages=("scorer", "recorder"))
    up = chain.start_up()
    assert up.process.wait(DEADLINE_S) == 1
    up.kill()
    assert any(line.endswith(f"recorded until then: {tmp_path}/recording.mcap") for line in up.lines)
    (error,) = [line for line in up.lines if line.startswith("fantwin:")]
    assert error.startswith(f"fantwin: {twin}: its calibration cannot be used: false_alarms_per_day: ")
    assert "Traceback" not in "\n".join(up.lines)
    started = chain.process_ids()
    assert "scorer" in started
    assert not any(map(is_running, started.values()))
