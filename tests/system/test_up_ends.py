"""How `fantwin up` ends when not all is well: nothing lost that can still be had, and never silently."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.recordings.reading import read_recording
from schemas.messages import Raw
from tests.support.running_chain import Chain, Running, eventually, fantwin, published, view_of


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint, "launcher.restart_delay_s=60", "launcher.restart_delay_max_s=60", viewer=False)
    try:
        chain.start_tray()
        chain.start_up()
        with chain.watcher() as watcher:
            eventually(lambda: published(view_of(watcher, "scorer")) > 100, "scores flow")
        yield chain
    finally:
        chain.close()


@pytest.mark.slow
def test_a_recorder_that_is_down_at_the_end_is_brought_back_for_what_it_missed(chain):
    os.kill(chain.process_ids()["recorder"], signal.SIGKILL)
    chain.up.line_with("recorder: was ended by signal 9")
    status = chain.up.end(signal.SIGINT)
    assert chain.tray.end() == 0
    assert status == 0, (chain.up.output()["lost"], chain.up.lines[-3:])
    kept = {
        int(sequence)
        for path in [*chain.folder.glob("recording*.mcap*")]
        for entry in read_recording(path, topics=("raw",))
        if isinstance(entry.message, Raw)
        for sequence in entry.message.device_sequence
    }
    assert kept == set(range(chain.tray.output()["samples_sent"]))


@pytest.mark.slow
def test_a_second_up_of_the_same_site_is_refused_and_leaves_the_first_alone(chain):
    second = fantwin(*chain.words("up"))
    assert second.returncode == 1
    assert "site 'demo' already runs at" in second.stderr
    assert "started, process" not in second.stderr
    assert chain.up.end(signal.SIGINT) == 0, chain.up.lines


@pytest.mark.slow
def test_a_stage_started_alone_stops_on_ctrl_c_while_others_go_on(chain):
    alone = Running([*chain.words("run"), "scorer"])
    try:
        with chain.watcher() as watcher:
            eventually(
                lambda: any(v.health.process_id == alone.process.pid for v in watcher.stages()),
                "the second scorer is seen",
            )
        assert alone.end(signal.SIGINT) == 0, alone.lines
    finally:
        alone.kill()
    assert chain.up.end(signal.SIGINT) == 0, chain.up.lines
