"""Alarms through the whole chain, in processes of their own: raised, acknowledged, shelved, and not forgotten."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.recordings.reading import read_recording
from schemas.messages import Alarm, Request, Transition
from tests.support.running_chain import TRAY, Chain, eventually, fantwin

pytestmark = pytest.mark.slow

FAULTY = 2
OF_THE_OCCURRENCE = (
    *("tray", "fan", "severity", "active", "onset_t_ns", "acknowledged", "confirmed", "latched"),
    *("acknowledged_by", "shelved_until_t_ns", "suppressed", "out_of_service", "retained", "presented"),
)


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint, "scorer.baseline_s=2", "twin_integrator.warm_up_s=2", viewer=False)
    try:
        yield chain
    finally:
        chain.close()


def listed(chain: Chain) -> list[dict[str, Any]]:
    done = fantwin(*chain.words("alarms"), "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["alarms"]


def ask(chain: Chain, *words: object) -> dict[str, Any]:
    """The answer for the one fan."""
    done = fantwin(*chain.words("alarms"), *words, "--json")
    assert done.returncode == 0, done.stderr
    (answer,) = json.loads(done.stdout)["answers"]
    return answer


def standing(chain: Chain) -> list[dict[str, Any]]:
    """The alarms that stand, without what goes on changing."""
    return [{name: alarm[name] for name in OF_THE_OCCURRENCE} for alarm in listed(chain)]


def test_a_fault_is_raised_acknowledged_and_shelved_and_a_killed_scorer_forgets_nothing(chain):
    chain.start_tray("--fault", f"inlet:fan={FAULTY},start=8,stop=600,size=2.5")
    up = chain.start_up()
    up.line_with("ALARM")
    (alarm,) = eventually(lambda: listed(chain), "an alarm stands")
    assert (alarm["tray"], alarm["fan"], alarm["active"], alarm["presented"]) == (TRAY, FAULTY, True, True)
    ask(chain, "ack", TRAY, FAULTY, "--operator", "Ann")
    ask(chain, "shelve", TRAY, FAULTY, "--for", "30m", "--operator", "Bob")
    ask(chain, "out-of-service", TRAY, 5)
    refused = fantwin(*chain.words("alarms"), "ack", TRAY, FAULTY)
    said = f"fantwin: {TRAY}: fan {FAULTY}: refused: it is acknowledged already\n"
    assert (refused.returncode, refused.stderr) == (1, said)
    before = standing(chain)
    assert [(a["fan"], a["acknowledged_by"], a["retained"], a["presented"], a["out_of_service"]) for a in before] == [
        (FAULTY, "Ann", True, False, False),
        (5, "", False, False, True),
    ]

    with chain.watcher() as watcher:
        chain.kill(watcher, "scorer")
    assert standing(chain) == before
    answer = ask(chain, "unshelve", TRAY, FAULTY)
    assert (answer["presented"], answer["onset_t_ns"]) == (True, alarm["onset_t_ns"])

    assert chain.tray
    chain.tray.end()
    up.end()
    account = up.output()
    assert account["lost"] == dict.fromkeys(account["lost"], 0), "commands that came and went are no loss"
    recorded = [entry.message for path in chain.recordings() for entry in read_recording(path)]
    requests = [message for message in recorded if isinstance(message, Request)]
    assert [message.operator_name for message in requests[:2]] == ["Ann", "Bob"]
    assert len(requests) == 5
    told = [message for message in recorded if isinstance(message, Alarm) and message.fan == FAULTY]
    raised = [alarm for alarm in told if alarm.transition == Transition.RAISED]
    assert [alarm.onset_t_ns for alarm in raised] == [answer["onset_t_ns"]]
    answered = {alarm.request for alarm in told if alarm.request}
    names = [f"{message.header.producer}/{message.header.sequence}" for message in requests if message.fan == FAULTY]
    assert set(names) == answered
