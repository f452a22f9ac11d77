"""A stage that hangs is found by its silence, killed and restarted; a stage that it blocks is not."""

from __future__ import annotations

import os
import signal

import pytest

from pipeline.launch.notices import Notices
from pipeline.launch.site_watcher import StageView
from pipeline.launch.watchdog import START_LIMIT_S, Watchdog
from pipeline.runtime.notifier import Notifier, starting
from schemas.enums import StageStatus
from tests.support.running_chain import Chain, eventually, view_of

LIMIT_S = 10.0


class Site:
    """A watchdog that is asked every tenth of a second about stages that are at work until they hang."""

    def __init__(self, *names: str) -> None:
        self.watchdog = Watchdog(LIMIT_S)
        self.now_s = 0.0
        self.hangs: set[str] = set()
        self.names = names
        for name in names:
            self.watchdog.started(name, 0.0)

    def hung_within(self, seconds: float) -> tuple[str, float] | None:
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s += 0.1
            for name in self.names:
                if name not in self.hangs:
                    self.watchdog.heard(name, self.now_s, is_ready=True)
            if hung := self.watchdog.hung(self.now_s):
                return hung
        return None


def test_row_01_a_stage_that_hangs_is_named_when_its_time_is_over():
    site = Site("scorer", "recorder")
    assert site.hung_within(20.0) is None
    site.hangs.add("scorer")
    assert site.hung_within(9.0) is None
    assert site.hung_within(2.0) == ("scorer", pytest.approx(LIMIT_S, abs=0.2))


def test_row_01_a_stage_blocked_by_one_that_hangs_is_not_named_in_its_place():
    site = Site("acquisition", "resampler", "scorer")
    site.hung_within(1.0)
    for name in ("scorer", "resampler", "acquisition"):  # each blocks the one before it half a second later
        site.hangs.add(name)
        site.hung_within(0.5)
    hung = site.hung_within(20.0)
    assert hung
    assert hung[0] == "scorer"
    site.names = ("acquisition", "resampler")
    assert site.hung_within(9.0) is None, "the others are given a new period"
    site.hangs.clear()
    assert site.hung_within(20.0) is None


def test_row_01_when_the_launcher_itself_did_not_run_no_stage_is_blamed():
    site = Site("scorer")
    site.hung_within(1.0)
    site.now_s += 3600.0
    assert site.watchdog.hung(site.now_s) is None
    assert site.hung_within(20.0) is None


def test_a_stage_that_starts_is_given_longer():
    watchdog = Watchdog(LIMIT_S)
    watchdog.started("scorer", 0.0)
    watchdog.heard("scorer", 1.0, is_ready=False)
    seconds = [second for second in range(200) if watchdog.hung(float(second))]
    assert seconds[0] == pytest.approx(START_LIMIT_S, abs=2.0)


def test_notices_follow_the_protocol_of_systemd():
    notices = Notices()
    notifier = Notifier(notices.address)
    assert not notices.read()
    notifier.at_work("starting")
    assert notices.read()
    assert (notices.is_ready, notices.status) == (False, "starting")
    notifier.ready()
    notifier.at_work("ok:\nall is well")
    assert notices.read()
    assert (notices.is_ready, notices.status) == (True, "ok: all is well")
    notices.close()
    notifier.stopping()  # nobody listens any more


def test_row_01_a_stage_that_is_built_for_long_says_that_it_is_at_work(monkeypatch):
    """As when the recorder repairs a large recording, or the router is not there yet."""
    notices = Notices()
    monkeypatch.setenv("NOTIFY_SOCKET", notices.address)
    with starting():
        eventually(notices.read, "a notice while it is built")
    assert (notices.is_ready, notices.status) == (False, "starting")
    with starting(limit_s=0.0):
        pass
    assert not notices.read(), "what takes too long hangs"
    notices.close()


def test_without_somebody_who_asks_nothing_is_sent(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notifier = Notifier.from_environment()
    notifier.ready()
    notifier.at_work("ok")


def test_a_launcher_that_reads_nothing_does_not_block_a_stage():
    notices = Notices()
    notifier = Notifier(notices.address)
    for _ in range(2000):
        notifier.ready()
        notifier.at_work("ok")
    assert notices.read()
    notices.close()


@pytest.mark.slow
def test_row_01_a_stage_that_is_stopped_for_good_is_killed_and_restarted(tmp_path, endpoint):
    chain = Chain(tmp_path, endpoint, 'launcher.stages=["recorder"]', "launcher.watchdog_s=1")
    try:
        up = chain.start_up()
        with chain.watcher() as watcher:

            def at_work() -> StageView | None:
                view = view_of(watcher, "recorder")
                return view if view and view.alive and view.health.status == StageStatus.OK else None

            first = eventually(at_work, "it is at work")
            os.kill(first.health.process_id, signal.SIGSTOP)
            line = up.line_with("recorder: hangs: its main loop has not run for ")

            def is_back() -> bool:
                view = view_of(watcher, "recorder")
                return bool(view and view.alive and view.health.process_id != first.health.process_id)

            eventually(is_back, "the recorder is back", deadline_s=20)
        assert line.endswith(" s; killed, restarting in 0.2 s")
        assert up.end(signal.SIGINT) == 0
        assert up.output()["restarts"] == {"recorder": 1}
    finally:
        chain.close()
