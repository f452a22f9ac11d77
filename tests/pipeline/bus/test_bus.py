"""The bus between sessions: nothing is lost, in any order of starting and after any death."""

from __future__ import annotations

import subprocess
import sys

import zenoh

from fantwin.pipeline.bus.recovery import recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.codec import type_name
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import BY_NAME, alive_key, tray_key
from tests.support.running_chain import eventually

KEY, TOPIC = tray_key("site", "tray", "alarm"), BY_NAME["alarm"]
COUNT = 400
HOLDS_THE_ENDPOINT = """
import sys
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
with Bus(BusConfig(endpoint=sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_peers_meet_after_the_process_at_the_endpoint_was_killed_and_the_last_one_gets_all_that_it_missed(endpoint):
    words = [sys.executable, "-c", HOLDS_THE_ENDPOINT, endpoint]
    config = BusConfig(endpoint=endpoint)
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout
        assert holder.stdout.readline() == "ready\n"
        with Bus(config) as first:
            holder.kill()
            publisher = first.publisher(KEY, TOPIC, type_name(Alarm), "peer")
            for number in range(COUNT):
                publisher.put(b"%d" % number)
            with Bus(config) as last:
                found = eventually(lambda: last.recover(KEY, "peer"), "they meet")
    assert sorted(int(payload) for _, payload in found) == list(range(COUNT))


def test_a_session_that_does_not_listen_leaves_the_endpoint_to_others(endpoint):
    config = BusConfig(endpoint=endpoint)
    with Bus(config, listens=False) as first, Bus(config) as staying:
        assert not staying.came_second
        staying.declare_alive(alive_key("site", "scorer", "all"))
        eventually(lambda: first.alive(alive_key("site", "*", "*")), "they meet all the same")
        with Bus(config, listens=False) as late:
            assert late.came_second


def test_row_11_a_request_that_makes_no_sense_is_answered_as_if_it_had_not_asked_that(endpoint, capfd):
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        bus.publisher(KEY, TOPIC, type_name(Alarm), "peer").put(b"kept")
        for asked in ("first=x", "last=-1", "newest=1e9", "newest=0", f"first={'9' * 5000}"):
            where, every_reply = f"{recovery_key(KEY, 'peer')}?{asked}", zenoh.ConsolidationMode.NONE
            replies = list(bus._session.get(where, timeout=20.0, consolidation=every_reply))
            assert [reply.ok.payload.to_bytes() for reply in replies if reply.ok] == [b"kept", b""], asked
        assert bus.recover(KEY, "nobody") == []
    assert "Traceback" not in capfd.readouterr().err
