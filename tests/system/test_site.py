"""One site in its own processes: a fault is raised, operators answer, every stage is killed, nothing is forgotten.

The whole chain runs once. The requests of operators come first because they must survive the kills. The recorder is
killed before the other stages, because its death alone must lose nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Request
from tests.stages.test_viewer import rows_of
from tests.support.fantwin_command import as_typed
from tests.support.offline_replay import without_topics
from tests.support.running_chain import FANS, TRAY, Chain, eventually, is_running, published, received, view_of

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY = 2
OF_THE_OCCURRENCE = (
    *("tray", "fan", "severity", "active", "onset_t_ns", "acknowledged", "confirmed", "latched"),
    *("acknowledged_by", "shelved_until_t_ns", "suppressed", "out_of_service", "retained", "presented"),
)


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint, "twin_integrator.warm_up_s=2")
    try:
        yield chain
    finally:
        chain.close()


def current_alarms(chain: Chain) -> list[dict[str, Any]]:
    """The alarms that `fantwin alarms` lists, without what keeps changing."""
    done = as_typed(*chain.words("alarms"), "--json")
    assert done.returncode == 0, done.stderr
    return [{name: alarm[name] for name in OF_THE_OCCURRENCE} for alarm in json.loads(done.stdout)["alarms"]]


def ask(chain: Chain, *words: object) -> dict[str, Any]:
    """The answer for the one fan."""
    done = as_typed(*chain.words("alarms"), *words, "--timeout", 300, "--json")
    assert done.returncode == 0, done.stderr
    (answer,) = json.loads(done.stdout)["answers"]
    return answer


def operate(chain: Chain) -> list[dict[str, Any]]:
    """Acknowledge and shelve the alarm, take another fan out of service; returns the alarms after that."""
    (alarm,) = eventually(lambda: current_alarms(chain), "an alarm stands")
    assert (alarm["tray"], alarm["fan"], alarm["active"], alarm["presented"]) == (TRAY, FAULTY, True, True)
    ask(chain, "ack", TRAY, FAULTY, "--operator", "Ann")
    ask(chain, "shelve", TRAY, FAULTY, "--for", "30m", "--operator", "Bob")
    ask(chain, "out-of-service", TRAY, 5)
    refused = as_typed(*chain.words("alarms"), "ack", TRAY, FAULTY, "--timeout", 300)
    expected = f"fantwin: {TRAY}: fan {FAULTY}: refused: it is acknowledged already\n"
    assert (refused.returncode, refused.stderr) == (1, expected)
    alarms = current_alarms(chain)
    assert [(a["fan"], a["acknowledged_by"], a["retained"], a["presented"], a["out_of_service"]) for a in alarms] == [
        (FAULTY, "Ann", True, False, False),
        (5, "", False, False, True),
    ]
    return alarms


def kill(chain: Chain, watcher: SiteWatcher, label: str) -> None:
    """Kill a stage and wait until samples flow through the whole chain again: it alone has been replaced."""
    before = chain.process_ids()
    chain.kill(watcher, label)
    scored = published(view_of(watcher, "scorer"))
    chain.eventually(watcher, lambda: published(view_of(watcher, "scorer")) > scored + 50, "scores flow again")
    if label == "recorder":
        chain.eventually(watcher, lambda: received(view_of(watcher, "recorder")) > 50, "the new recorder records")
    after = chain.process_ids()
    assert {name for name in after if after[name] != before[name]} == {label}
    assert is_running(after[label])


def recorded_sequences(chain: Chain) -> dict[tuple[str, str], set[int]]:
    """(topic, producer) -> sequence numbers in all recordings together."""
    found: dict[tuple[str, str], set[int]] = {}
    for path in chain.recordings():
        for entry in read_recording(path):
            header = entry.message.header
            found.setdefault((entry.topic, header.producer), set()).add(header.sequence)
    return found


def recorded_values(chain: Chain, topic: str, column: str) -> set[int]:
    """All values of a column of samples in all recordings together."""
    entries = (entry for path in chain.recordings() for entry in read_recording(path, topics=[topic]))
    return {int(value) for entry in entries for value in getattr(entry.message, column)}


def check_account(chain: Chain, sent: dict[str, Any], account: dict[str, Any], status: int) -> None:
    """Every sample that the device counted is recorded or counted as lost, and only the pause may lose any."""
    assert account["restarts"] == dict.fromkeys(chain.stages, 1)
    assert account["killed"] == []
    lost = sum(account["lost"].values())
    # what nobody took while acquisition was dead has a number of the device too, and counts as lost
    assert sent["samples_unsent"] > 0
    recorded = recorded_values(chain, "raw", "device_sequence")
    assert len(recorded) + lost >= sent["samples_sent"] + sent["samples_unsent"]
    assert 0 < lost <= sent["samples_unsent"] + 200, f"lost is what fell into the pause, not more: {account}"
    assert status == 3


def check_recordings(chain: Chain) -> None:
    """The recordings together have all that any session published of samples and decisions, and each grid's score."""
    assert len(chain.recordings()) == 2
    for (topic, producer), numbers in recorded_sequences(chain).items():
        if topic == "health":  # those that say something new are recorded
            continue
        assert numbers == set(range(max(numbers) + 1)), f"{topic} of {producer} has holes"
    times = sorted(recorded_values(chain, "grid", "t_ns"))
    assert times == list(range(times[0], times[-1] + 1, 10_000_000))
    assert recorded_values(chain, "prediction", "t_ns") == recorded_values(chain, "score", "t_ns") == set(times)


def check_supply(chain: Chain) -> None:
    """The voltage that the tray measures is in each message on the way to the score, and in the view."""
    for topic in ("raw", "grid", "prediction", "score"):
        entries = [entry for path in chain.recordings() for entry in read_recording(path, topics=[topic])]
        messages: list[Any] = [entry.message for entry in entries]
        volts = np.concatenate([np.reshape(message.supply_voltage_v, (-1, FANS)) for message in messages])
        assert len(volts) > 1_000, topic
        assert np.nanmedian(volts, axis=0) == pytest.approx(12.0, abs=0.02), topic
        assert np.isfinite(volts).mean() > 0.5, f"{topic}: unknown only in the pause of acquisition"
    newest = max(chain.folder.glob("view*.rrd"), key=lambda path: path.stat().st_mtime_ns)
    rows = rows_of(newest)
    shown = [row["Scalars:scalars"][0] for _, row in rows[f"/{TRAY}/supply_voltage_v/fan_{FAULTY}"]]
    assert np.nanmedian(shown) == pytest.approx(12.0, abs=0.02)


def check_alarms(chain: Chain, onset_t_ns: int) -> None:
    """The alarm was raised once, and each request of the operators was answered under its name."""
    recorded = [entry.message for path in chain.recordings() for entry in read_recording(path, ("alarm", "request"))]
    requests = [message for message in recorded if isinstance(message, Request)]
    by_time = sorted(requests, key=lambda request: request.t_ns)
    assert [message.operator_name for message in by_time[:2]] == ["Ann", "Bob"]
    assert len(requests) == 5
    alarms = [message for message in recorded if isinstance(message, Alarm) and message.fan == FAULTY]
    raised = {alarm.onset_t_ns for alarm in alarms if alarm.transition == Transition.RAISED}
    assert raised == {onset_t_ns}
    names = {f"{message.header.producer}/{message.header.sequence}" for message in requests if message.fan == FAULTY}
    assert names == {alarm.request for alarm in alarms if alarm.request}


def check_replay(chain: Chain) -> None:
    """A replay that is given what each session was given decides the same, to the bit.

    The last message of a killed process may have reached one subscriber and not the other. What the resampler took and
    the recorder did not cannot be computed again; the replay then says so, and where. It needs no scores for that: what
    the stages report of what they had consumed says the same.
    """
    recordings = list(chain.recordings())
    made_again = ("grid", "prediction", "score")
    lean = [without_topics(path, path.with_name(f"lean-{path.name}"), *made_again) for path in recordings]
    for paths, compared in ((recordings, "samples_equal"), (lean, "snapshots_equal")):
        done = as_typed("replay", "--offline", "--verify", "--json", *paths)
        verified = json.loads(done.stdout)["verified"]
        assert verified["equal"], verified["differences"]
        assert verified[compared] > (1_000 if paths is recordings else 5)
        assert verified["alarms_equal"] >= 6, "the alarm, and the answers to five requests"
        reasons = verified["not_comparable"]
        assert done.returncode == (3 if reasons else 0), done.stderr
        expected = re.compile(rf"{TRAY}: after .*Z: the recording lacks 1 raw messages that were scored")
        assert len(reasons) <= 1, reasons
        assert all(expected.fullmatch(reason) for reason in reasons), reasons


def test_operators_are_answered_and_killed_stages_come_back_without_losing_state(chain):
    fault = ("--fault", f"inlet:fan={FAULTY},start=8,stop=600,size=2.5")
    chain.start_tray(*fault, "--set", "surroundings.measured=['supply_voltage_v']")
    up = chain.start_up()
    up.line_with("ALARM")
    before = operate(chain)

    with chain.watcher() as watcher:
        kill(chain, watcher, "recorder")
        assert not any(watcher.losses().values()), "neither a killed recorder nor commands that come and go lose any"
        kill(chain, watcher, "scorer")
        assert current_alarms(chain) == before
        answer = ask(chain, "unshelve", TRAY, FAULTY)
        assert (answer["presented"], answer["onset_t_ns"]) == (True, before[0]["onset_t_ns"])

        kill(chain, watcher, chain.stages[0])
        shown = as_typed(*chain.words("status"), "--json")
        (resampler,) = (stage for stage in json.loads(shown.stdout)["stages"] if stage["stage"] == "resampler")
        assert shown.returncode == 3, "a running site says that it has lost something"
        # what the killed process had read and not yet sent is lost as well, and counted beside it
        assert 0 < resampler["counters"]["lost_between_sessions"] <= resampler["lost"]
        for label in ("resampler", "twin_integrator", "viewer"):
            kill(chain, watcher, label)

    assert chain.tray and chain.tray.end() == 0
    sent = chain.tray.output()
    status = up.end()
    check_account(chain, sent, up.output(), status)
    check_recordings(chain)
    check_alarms(chain, answer["onset_t_ns"])
    check_supply(chain)

    check_replay(chain)
