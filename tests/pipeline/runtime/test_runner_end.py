"""The end of a stage: it comes within its time, and leaves the bus, whatever raises or hangs on the way."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.bus.recovery import recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import LauncherConfig
from fantwin.pipeline.config.shards import chosen_shard
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import health_key, tray_key
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Burst, Passer, raw, toy


class Ended:
    """A stage that was run to its end in a thread, with what it raised and what others saw of it."""

    def __init__(self, stage: Stage, config, *, tray: str | None = None) -> None:
        self.stop = threading.Event()
        self.error: Exception | None = None
        self.healths: list[Health] = []
        self.has_left_the_bus = False
        with Bus(config.bus) as watching:
            watching.subscribe(health_key("s", "*", "*"), self._keep)
            self.runner = Runner(stage, config, chosen_shard(stage.name, config, tray), self.stop)
            close = self.runner._bus.close

            def close_and_say() -> None:
                close()
                self.has_left_the_bus = True

            self.runner._bus.close = close_and_say
            thread = threading.Thread(target=self._run, daemon=True)
            thread.start()
            eventually(lambda: any(h.status == StageStatus.OK for h in self.healths), "it runs")
            self.stop.set()
            thread.join(20)
            self.has_ended = not thread.is_alive()
            eventually(lambda: self.healths[-1].status != StageStatus.OK, "its last health arrived")

    def _keep(self, _key: str, payload: bytes) -> None:
        health = decode(Health, payload)
        assert isinstance(health, Health)
        self.healths.append(health)

    def _run(self) -> None:
        try:
            self.runner.run()
        except Exception as error:  # noqa: BLE001  looked at by the test
            self.error = error

    @property
    def problem(self) -> str:
        return self.healths[-1].problem


class RaisesAtClose(Passer):
    """Its file cannot be flushed."""

    def close(self) -> Sequence[Message]:
        raise OSError(30, "Read-only file system")

    def abort(self) -> None:
        raise OSError(30, "Read-only file system")


def test_row_04_a_core_that_raises_while_it_is_closed_keeps_no_other_from_closing_and_is_reported(config):
    closed: list[str] = []

    def build(context: Context) -> BuiltStage:
        class Closes(Passer):
            def close(self) -> Sequence[Message]:
                closed.append(context.tray.name)
                return []

        return BuiltStage(RaisesAtClose() if context.tray.name == TRAY_A else Closes())

    ended = Ended(toy(build), config)
    assert ended.has_ended
    assert ended.has_left_the_bus
    assert closed == [TRAY_B]
    assert isinstance(ended.error, OSError)
    assert ended.healths[-1].status == StageStatus.DEGRADED
    assert [health.is_last for health in ended.healths[-2:]] == [False, True]
    assert "closing a failed: OSError: [Errno 30] Read-only file system" in ended.problem


def test_row_04_a_core_that_hangs_while_it_is_closed_is_left_behind_in_time(config, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.CORES_CLOSED", 0.05)
    release = threading.Event()

    class Hangs(Passer):
        def close(self) -> Sequence[Message]:
            release.wait()
            return []

    ended = Ended(toy(lambda _context: BuiltStage(Hangs()), core_per_tray=False), config)
    release.set()
    assert ended.has_ended
    eventually(lambda: ended.has_left_the_bus, "it leaves the bus, which it waits for no longer than the core's time")
    assert isinstance(ended.error, UserError)
    assert "closing the core did not end in time" in ended.problem


@pytest.mark.parametrize("who", ["stop", "launcher_gone"])
def test_row_04_a_loop_that_hangs_is_left_behind_in_time(config, monkeypatch, who):
    """A consumer hangs and takes no more of what is published; also where nobody is left to kill the stage."""
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.PRODUCERS_END_LIMIT_S", 0.1)
    release, hanging = threading.Event(), threading.Event()

    class Hangs(Passer):
        def tick(self, now_ns: int) -> Sequence[Message]:
            hanging.set()
            release.wait()
            return []

    stop = threading.Event()
    settings = replace(config, launcher=LauncherConfig(watchdog_s=1.0))
    runner = Runner(toy(lambda _context: BuiltStage(Hangs()), core_per_tray=False), settings, None, stop)
    errors: list[UserError] = []

    def run() -> None:
        with pytest.raises(UserError) as raised:
            runner.run()
        errors.append(raised.value)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert hanging.wait(20)
    getattr(runner, who).set()
    thread.join(20)
    release.set()
    assert "processing what had arrived did not end in time" in str(errors[0])


def test_row_04_a_stage_that_is_stopped_while_it_waits_for_what_it_missed_ends_in_order(config, monkeypatch):
    """A producer hangs."""
    monkeypatch.setattr(Bus, "answer_timeout_s", 300.0)
    for limit in ("CAUGHT_UP", "ANSWERED"):
        monkeypatch.setattr(f"fantwin.pipeline.runtime.runner.{limit}", 0.05)
    stop, asked = threading.Event(), threading.Event()
    queries: list[Any] = []

    def never_answer(query: Any) -> None:
        queries.append(query)
        asked.set()

    with Bus(config.bus) as bus:
        silent = bus._session.declare_queryable(recovery_key(tray_key("s", TRAY_A, "raw"), "hangs"), never_answer)
        runner = Runner(toy(), config, None, stop)
        thread = threading.Thread(target=runner.run)
        thread.start()
        assert asked.wait(20)
        stop.set()
        thread.join(20)
        for query in queries:
            query.drop()
        silent.undeclare()
    assert not thread.is_alive()
    assert not runner.is_hung


class StopRaises(Burst):
    """A source whose port is gone."""

    def stop(self) -> None:
        super().stop()
        raise OSError(5, "Input/output error")


def test_row_04_a_source_that_raises_while_it_is_stopped_does_not_keep_the_stage_from_ending(config):
    stage = toy(lambda _context: BuiltStage(Passer(), StopRaises([raw(1)])), name="acquisition")
    ended = Ended(stage, config, tray=TRAY_A)
    assert ended.has_ended
    assert "stopping the source failed: OSError: [Errno 5] Input/output error" in ended.problem
    assert ended.healths[-1].outputs[0].published == 2, "what it had delivered was published"


BLOCKED = """
import ctypes, threading
from fantwin.pipeline.runtime.signals import stop_on_signals
stop_on_signals()
libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)
libc.pthread_mutex_lock(mutex)
print("blocked", flush=True)
libc.pthread_mutex_lock(mutex)  # no signal interrupts this, as in a call of the bus
"""


def test_row_04_the_second_signal_ends_a_process_whose_main_thread_is_blocked():
    process = subprocess.Popen([sys.executable, "-c", BLOCKED], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout
        assert process.stdout.readline() == "blocked\n"

        def ends_after_a_signal() -> bool:
            process.terminate()
            return process.poll() is not None

        eventually(ends_after_a_signal, "it has ended", deadline_s=20)
        assert process.returncode == 128 + 15
    finally:
        process.kill()
        process.wait()
        assert process.stdout
        process.stdout.close()


def test_row_18_what_is_not_processed_in_time_is_counted_as_lost(config, monkeypatch):
    """A device that sends faster than the stage can process."""
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.DRAINED", 0.1)

    class Slow(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            threading.Event().wait(0.05)
            return super().step(item)

    stage = toy(lambda _context: BuiltStage(Slow(), Burst([raw(t_ns) for t_ns in range(200)])), name="acquisition")
    ended = Ended(stage, config, tray=TRAY_A)
    last = ended.healths[-1]
    assert ended.error is None
    assert last.status == StageStatus.STOPPED
    counters = {counter.name: counter.value for counter in last.counters}
    assert counters["lost_at_stop"] > 0
    assert counters["lost_at_stop"] + last.outputs[0].published - 1 == 200
    assert last.lost >= counters["lost_at_stop"]
