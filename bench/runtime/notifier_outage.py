"""A mail server that is away for ten minutes: what the notifier, as a process on a real bus, sends when it is back.

While it is away an alarm comes every 20 s, in the middle 500 fans at once (a power cut), and later the notifier is
killed. Printed: mails, whether each arrived once and in order, when they arrived after the server was back, how long
the scorer was held up by the longest `put`, and what the notifier cost.
"""

from __future__ import annotations

import resource
import socket
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.printing import JsonOption, progress, show
from pipeline.bus.session import Bus
from pipeline.config.models import BusConfig
from pipeline.notification.sending import MAY_BE_REPEATED
from schemas.codec import encode, type_name
from schemas.messages import Alarm
from schemas.topics import BY_NAME, tray_key
from stages.notifier import OUTBOX
from tests.support.message_receivers import MailServer
from tests.support.notified_alarms import alarm, secret
from tests.support.running_chain import RunningCommand, eventually

EVERY_S = 20.0
CUT_FANS = 500
FANS = 1000
KILLED_AT = 0.7
CONFIGURATION = """
site = "hall"
run_folder = "runs"
bus.endpoint = "{endpoint}"
[[tray]]
name = "tray1"
fans = {fans}
source = {{ kind = "push" }}
[notifier]
[[notifier.target]]
name = "mail"
url_file = "mail.url"
"""


def main(
    outage_s: Annotated[float, typer.Option(min=60, help="How long the mail server is away.")] = 600.0,
    as_json: JsonOption = False,
) -> None:
    with tempfile.TemporaryDirectory() as folder, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        probe.close()
        measure(Path(folder), endpoint, outage_s, as_json)


def measure(folder: Path, endpoint: str, outage_s: float, as_json: bool) -> None:
    config = folder / "fantwin.toml"
    config.write_text(CONFIGURATION.format(endpoint=endpoint, fans=FANS))
    mail = MailServer()
    mail.start()
    secret(folder, "mail", mail.url)
    words = ["run", "notifier", "-c", config]
    puts_s: list[float] = []
    expected: list[str] = []
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        publisher = bus.publisher(
            tray_key("hall", "tray1", "alarm"), BY_NAME["alarm"], type_name(Alarm), "scorer-all-1"
        )

        def publish(fan: int) -> None:
            payload, before_s = encode(alarm(fan=fan, sequence=publisher.published)), time.monotonic()
            publisher.put(payload)
            puts_s.append(time.monotonic() - before_s)

        def publish_one(fan: int) -> None:
            publish(fan)
            expected.append(f"WARNING, fan {fan} of tray1 (hall)")

        notifier = RunningCommand(words)
        try:
            publish_one(0)
            eventually(lambda: mail.mails, "the first arrives")
            mail.stop()
            progress(f"the mail server is away for {outage_s:.0f} s")
            began_s, fan, is_cut, is_killed = time.monotonic(), 1, False, False
            while (gone_s := time.monotonic() - began_s) < outage_s - EVERY_S:
                publish_one(fan)
                fan += 1
                time.sleep(EVERY_S)
                if not is_cut and gone_s > outage_s / 2:
                    is_cut = True
                    for each in range(CUT_FANS):
                        publish(FANS - 1 - each)
                    expected.append(f"{CUT_FANS} alarms in 1 tray (hall): {CUT_FANS} WARNING")
                    time.sleep(EVERY_S)
                if not is_killed and gone_s > KILLED_AT * outage_s:
                    is_killed = True
                    notifier.kill()
                    notifier = RunningCommand(words)
            time.sleep(max(0.0, outage_s - (time.monotonic() - began_s)))
            mail.start()
            back_s = time.time()
            progress("the mail server is back")
            eventually(lambda: len(mail.mails) >= len(expected) and not waiting(folder), "all arrive", deadline_s=600)
            notifier.end()
        finally:
            notifier.kill()
            mail.stop()
    cost = resource.getrusage(resource.RUSAGE_CHILDREN)
    counts = Counter(mail.subjects())
    arrived_s = [each - back_s for each in mail.received_s[1:]]
    row = {
        "away, s": outage_s,
        "mails": len(mail.mails),
        "missing": sum(subject not in counts for subject in expected),
        "twice": sum(counts.values()) - len(counts),
        "marked": sum(MAY_BE_REPEATED in body for _, body in mail.mails),
        "in order": "yes" if mail.subjects() == expected else "no",
        "first after, s": min(arrived_s),
        "last after, s": max(arrived_s),
        "longest put, ms": 1000 * max(puts_s),
        "CPU, s": cost.ru_utime + cost.ru_stime,
        "memory, MB": cost.ru_maxrss / 1024,
    }
    show({"Mail server away": [row]}, ["times are from the return of the server"], as_json=as_json)


def waiting(folder: Path) -> int:
    file = sqlite3.connect(f"file:{folder / 'runs' / OUTBOX}?mode=ro", uri=True)
    try:
        return file.execute("SELECT COUNT(*) FROM message").fetchone()[0]
    finally:
        file.close()


if __name__ == "__main__":
    typer.run(main)
