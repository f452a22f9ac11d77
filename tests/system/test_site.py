"""One site in its own processes: a fault is raised, operators answer, stages are killed, nothing is forgotten.

The requests of operators come first because they must survive the kills. The recorder is killed before the other
stages, because its death alone must lose nothing.
"""

from __future__ import annotations

import json
import re
import subprocess
import urllib.request
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.enums import Transition
from tests.support.fantwin_command import as_typed
from tests.support.ports import free_port
from tests.support.running_chain import (
    DEADLINE_S,
    STAGES,
    STEP_NS,
    TRAY,
    Chain,
    eventually,
    is_running,
    published,
    received,
    view_of,
)

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

FAULTY = 2
OF_THE_OCCURRENCE = (
    *("tray", "fan", "severity", "active", "onset_t_ns", "acknowledged"),
    *("acknowledged_by", "shelved_until_t_ns", "out_of_service", "retained", "presented"),
)


@pytest.fixture
def page() -> str:
    """The address of the operators' page."""
    return f"http://127.0.0.1:{free_port()}"


@pytest.fixture
def chain(page: str, new_chain: Callable[..., Chain]) -> Chain:
    settings = ("twin_integrator.warm_up_s=2", f"gateway.port={page.rpartition(':')[2]}")
    return new_chain(*settings, stages=(*STAGES, "gateway"))


def current_alarms(chain: Chain) -> list[dict[str, Any]]:
    """The alarms that `fantwin alarms` lists once every fan is judged now, without what keeps changing."""

    def said() -> subprocess.CompletedProcess[str] | None:
        asked = as_typed(*chain.words("alarms"), "--json")
        return asked if asked.returncode == 0 else None

    done = eventually(said, "every fan is judged")
    return [{name: alarm[name] for name in OF_THE_OCCURRENCE} for alarm in json.loads(done.stdout)["alarms"]]


def ask(chain: Chain, *words: object) -> dict[str, Any]:
    """The answer for the one fan."""
    done = as_typed(*chain.words("alarms"), *words, "--timeout", DEADLINE_S, "--json")
    assert done.returncode == 0, done.stderr
    (answer,) = json.loads(done.stdout)["answers"]
    return answer


def operate(chain: Chain) -> list[dict[str, Any]]:
    """Acknowledge and shelve the alarm, take another fan out of service; returns the alarms after that."""
    (alarm,) = eventually(lambda: current_alarms(chain), "an alarm stands")
    assert (alarm["tray"], alarm["fan"], alarm["active"], alarm["presented"]) == (TRAY, FAULTY, True, True)
    ask(chain, "acknowledge", TRAY, FAULTY, "--operator", "Ann")
    ask(chain, "shelve", TRAY, FAULTY, "--for", "30m", "--operator", "Bob")
    ask(chain, "out-of-service", TRAY, 5)
    refused = as_typed(*chain.words("alarms"), "acknowledge", TRAY, FAULTY, "--timeout", DEADLINE_S)
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
    chain.eventually(watcher, lambda: published(view_of(watcher, "scorer")) > scored + 20, "scores flow again")
    if label == "recorder":
        chain.eventually(watcher, lambda: received(view_of(watcher, "recorder")) > 20, "the new recorder records")
    after = chain.process_ids()
    assert {name for name in after if after[name] != before[name]} == {label}
    assert is_running(after[label])


def alarms_on_the_page(page: str) -> list[tuple[int, str]]:
    """Fan and who has acknowledged it, of each alarm that the page lists."""
    with urllib.request.urlopen(f"{page}/api/v1/alarms", timeout=20) as answer:
        return [(alarm["fan"], alarm["acknowledged_by"]) for alarm in json.load(answer)["alarms"]]


Recorded = dict[str, list[Any]]


def recorded(chain: Chain) -> Recorded:
    """The messages in both recordings together, by topic."""
    found: Recorded = {}
    paths = chain.recordings()
    assert len(paths) == 2
    for entry in (entry for path in paths for entry in read_recording(path)):
        found.setdefault(entry.topic, []).append(entry.message)
    return found


def times(messages: list[Any]) -> set[int]:
    return {int(t_ns) for message in messages for t_ns in message.t_ns}


def check_account(chain: Chain, raws: list[Any], sent: dict[str, Any], account: dict[str, Any], status: int) -> None:
    """Every sample that the device counted is recorded or counted as lost, and only the pause may lose any."""
    assert account["restarts"] == dict.fromkeys((label for label in chain.stages if label != "twin_integrator"), 1)
    assert account["killed"] == []
    lost = sum(account["lost"].values())
    # what nobody took while acquisition was dead has a number of the device too, and counts as lost
    assert sent["samples_unsent"] > 0
    numbers = {int(number) for raw in raws for number in raw.device_sequence}
    assert len(numbers) + lost >= sent["samples_sent"] + sent["samples_unsent"]
    assert 0 < lost <= sent["samples_unsent"] + 100, f"lost is what fell into the pause, not more: {account}"
    assert status == 3


def check_recordings(found: Recorded) -> None:
    """The recordings together have all that any session published of samples and decisions, and each grid's score."""
    numbers: dict[tuple[str, str], set[int]] = {}
    for topic, messages in found.items():
        if topic != "health":  # those that say something new are recorded
            for message in messages:
                numbers.setdefault((topic, message.header.producer), set()).add(message.header.sequence)
    assert [key for key, each in numbers.items() if each != set(range(max(each) + 1))] == [], "holes"
    grid = times(found["grid"])
    steps_ns = np.diff(sorted(grid))
    assert (steps_ns % STEP_NS == 0).all()
    assert np.count_nonzero(steps_ns > STEP_NS) <= 1, "only the pause of acquisition may be one"
    assert not grid ^ times(found["prediction"])
    assert not grid ^ times(found["score"])


def check_alarms(found: Recorded, onset_t_ns: int) -> None:
    """The alarm was raised once, and each request of the operators was answered under its name."""
    requests = sorted(found["request"], key=lambda request: request.t_ns)
    assert [message.operator_name for message in requests[:2]] == ["Ann", "Bob"]
    assert len(requests) == 5
    alarms = [alarm for alarm in found["alarm"] if alarm.fan == FAULTY]
    assert {alarm.onset_t_ns for alarm in alarms if alarm.transition == Transition.RAISED} == {onset_t_ns}
    names = {f"{message.header.producer}/{message.header.sequence}" for message in requests if message.fan == FAULTY}
    assert names == {alarm.request for alarm in alarms if alarm.request}


def check_replay(chain: Chain) -> None:
    """A replay that is given what each session was given decides the same, to the bit.

    The last message of a killed process may have reached one subscriber and not the other. What the resampler took and
    the recorder did not cannot be computed again; the replay then says so, and where.
    """
    done = as_typed("replay", "--offline", "--verify", "--json", *chain.recordings())
    verified = json.loads(done.stdout)["verified"]
    assert verified["equal"], verified["differences"]
    assert verified["samples_equal"] > 1_000
    assert verified["alarms_equal"] >= 6, "the alarm, and the answers to five requests"
    reasons = verified["not_comparable"]
    assert done.returncode == (3 if reasons else 0), done.stderr
    expected = re.compile(rf"{TRAY}: after .*Z: the recording lacks 1 raw messages that were scored")
    assert len(reasons) <= 1 and all(expected.fullmatch(reason) for reason in reasons), reasons


def test_operators_are_answered_and_killed_stages_come_back_without_losing_state(chain, page):
    chain.start_tray("--fault", f"inlet:fan={FAULTY},start=6,stop=600,size=2.5")
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
        kill(chain, watcher, "resampler")
        kill(chain, watcher, "gateway")
        eventually(lambda: (FAULTY, "Ann") in alarms_on_the_page(page), "the page knows what Ann has acknowledged")

    assert chain.tray and chain.tray.end() == 0
    sent = chain.tray.output()
    status = up.end()
    found = recorded(chain)
    check_account(chain, found["raw"], sent, up.output(), status)
    check_recordings(found)
    check_alarms(found, answer["onset_t_ns"])
    check_replay(chain)
