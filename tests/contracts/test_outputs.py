"""One list of claims over every output: page, metrics, OPC UA, MQTT, notifier and viewer show the same alarms."""

from __future__ import annotations

import itertools
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.schemas.enums import FanState, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm
from tests.support.outputs import OUTPUTS, Output
from tests.support.running_chain import eventually
from tests.support.running_core import TRAY
from tests.support.score_data import one_sample
from tests.support.site_messages import NOW_NS, alarm, score

pytestmark = pytest.mark.usefixtures("quickly_hashed")
SEEN = {"acknowledged": True, "operator_name": "ann"}
SHELVED = {"shelved_until_t_ns": NOW_NS + 10**13}
_numbers = itertools.count(100)


def of(fan: int, transition: Transition = Transition.RAISED, **more: object) -> Alarm:
    """The next transition."""
    return replace(alarm(transition, next(_numbers), **more), fan=fan)


def shows(output: Output, fan: int, expected: tuple[bool, bool] | None) -> None:
    """Wait until it shows that a fan is in alarm, and whether that is acknowledged and silenced; None: no alarm."""

    def is_shown() -> bool:
        found = output.alarms().get(fan)
        return found == expected if output.keeps_state else (found is None) == (expected is None)

    eventually(is_shown, f"fan {fan} is shown as {expected}")


@pytest.fixture(scope="module", params=OUTPUTS)
def kind(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "mqtt" and shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("fantwin.pipeline.site.site_model.SILENT_AFTER_S", 1e9)
        yield request.param


def test_an_alarm_of_before_it_started_is_shown_again_after_a_restart_and_its_end_leaves_nothing_behind(
    kind: str, tmp_path: Path
) -> None:
    """First, so that no thread of an output that other tests share is counted."""
    threads = set(threading.enumerate())
    raised = of(2)
    for again in ((), (of(2, Transition.REPUBLISHED), of(1))):
        running = OUTPUTS[kind](tmp_path)
        try:
            running.feed(raised, *again)
            shows(running, 2, (False, False))
            shows(running, 1, (False, False) if again else None)
        finally:
            running.close()
            running.close()
    eventually(lambda: not [each for each in set(threading.enumerate()) - threads if each.is_alive()], "all has ended")


@pytest.fixture(scope="module")
def output(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Output]:
    """One for all claims: each has its own fan."""
    running = OUTPUTS[kind](tmp_path_factory.mktemp(kind))
    yield running
    running.close()


def test_an_alarm_is_shown_acknowledged_silenced_and_gone_whoever_asked(output: Output) -> None:
    output.feed(score(), of(0))
    shows(output, 0, (False, False))
    output.feed(of(0, Transition.ACKNOWLEDGED, **SEEN))
    shows(output, 0, (True, False))
    output.feed(of(0, Transition.SHELVED, **SHELVED, **SEEN))
    shows(output, 0, (True, True))
    output.feed(of(0, Transition.UNSHELVED, **SEEN))
    shows(output, 0, (True, False))
    output.feed(of(0, Transition.CLEARED, active=False, **SEEN), score(9.0))
    shows(output, 0, None)


def test_a_late_message_ends_no_alarm(output: Output) -> None:
    late = of(2, Transition.CLEARED, active=False)
    output.feed(score(10.0, state=FanState.ALARM), of(2), late)
    output.feed(score(11.0, state=FanState.STOPPED))
    shows(output, 2, (False, False))


def test_what_it_does_not_know_is_counted_or_shown_and_ends_nothing(output: Output) -> None:
    before = output.refused()
    output.feed(
        of(3, Transition(88), active=False, severity=Severity.NONE),
        of(3, severity=Severity(77)),
        of(99),
        replace(of(1), header=Header("scorer-all-1", next(_numbers), "elsewhere")),
        score(20.0, state=FanState(99)),
        replace(one_sample(9), header=Header("scorer-all-1", next(_numbers), TRAY)),
        of(1),
    )
    shows(output, 1, (False, False))
    assert output.refused() - before >= 1
