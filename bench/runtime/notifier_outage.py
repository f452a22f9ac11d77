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
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.outputs.notify.sending import MAY_BE_REPEATED
from fantwin.pipeline.site.alarm_history import FILE
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import BY_NAME, tray_key
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


class Site:
    """A scorer that publishes alarms, a mail server, and a notifier in a process."""

    def __init__(self, folder: Path, bus: Bus, endpoint: str) -> None:
        config = folder / "fantwin.toml"
        config.write_text(CONFIGURATION.format(endpoint=endpoint, fans=FANS))
        self.mail = MailServer()
        self.mail.start()
        secret(folder, "mail", self.mail.url)
        self._folder = folder
        self._words = ["up", "--only", "notifier", "-c", config]
        key = tray_key("hall", "tray1", "alarm")
        self._publisher = bus.publisher(key, BY_NAME["alarm"], type_name(Alarm), "scorer-all-1")
        self.puts_s: list[float] = []
        self.expected: list[str] = []
        self.notifier = RunningCommand(self._words)

    def publish(self, *fans: int) -> None:
        for fan in fans:
            payload = encode(alarm(fan=fan, sequence=self._publisher.published))
            before_s = time.monotonic()
            self._publisher.put(payload)
            self.puts_s.append(time.monotonic() - before_s)
        one, many = (
            f"WARNING, fan {fans[0]} of tray1 (hall)",
            f"{len(fans)} alarms in 1 tray (hall): {len(fans)} WARNING",
        )
        self.expected.append(one if len(fans) == 1 else many)

    def outage(self, outage_s: float) -> None:
        """The server is away; a power cut in the middle, and then a kill."""
        self.mail.stop()
        began_s, fan, is_cut, is_killed = time.monotonic(), 1, False, False
        while (gone_s := time.monotonic() - began_s) < outage_s - EVERY_S:
            self.publish(fan)
            fan += 1
            time.sleep(EVERY_S)
            if not is_cut and gone_s > outage_s / 2:
                is_cut = True
                self.publish(*range(FANS - CUT_FANS, FANS))
                time.sleep(EVERY_S)
            if not is_killed and gone_s > KILLED_AT * outage_s:
                is_killed = True
                self.notifier.kill()
                self.notifier = RunningCommand(self._words)
        time.sleep(max(0.0, outage_s - (time.monotonic() - began_s)))
        self.mail.start()

    def is_done(self) -> bool:
        return len(self.mail.mails) >= len(self.expected) and not waiting(self._folder)

    def close(self) -> None:
        self.notifier.end()
        self.notifier.kill()
        self.mail.stop()


def main(
    outage_s: Annotated[float, typer.Option(min=60, help="How long the mail server is away.")] = 600.0,
    as_json: JsonOption = False,
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder, Bus(BusConfig(endpoint=endpoint)) as bus:
        site = Site(Path(folder), bus, endpoint)
        try:
            site.publish(0)
            eventually(lambda: site.mail.mails, "the first arrives")
            progress(f"the mail server is away for {outage_s:.0f} s")
            site.outage(outage_s)
            back_s = time.time()
            progress("the mail server is back")
            eventually(site.is_done, "all arrive", deadline_s=600)
        finally:
            site.close()
    show({"Mail server away": [row_of(site, outage_s, back_s)]}, ["from the return of the server"], as_json=as_json)


def row_of(site: Site, outage_s: float, back_s: float) -> dict[str, float | str]:
    cost, mail = resource.getrusage(resource.RUSAGE_CHILDREN), site.mail
    counts = Counter(mail.subjects())
    arrived_s = [each - back_s for each in mail.received_s[1:]]
    return {
        "away, s": outage_s,
        "mails": len(mail.mails),
        "missing": sum(subject not in counts for subject in site.expected),
        "twice": sum(counts.values()) - len(counts),
        "marked": sum(MAY_BE_REPEATED in body for _, body in mail.mails),
        "in order": "yes" if mail.subjects() == site.expected else "no",
        "first after, s": min(arrived_s),
        "last after, s": max(arrived_s),
        "longest put, ms": 1000 * max(site.puts_s),
        "CPU, s": cost.ru_utime + cost.ru_stime,
        "memory, MB": cost.ru_maxrss / 1024,
    }


def waiting(folder: Path) -> int:
    file = sqlite3.connect(f"file:{folder / 'runs' / FILE}?mode=ro", uri=True)
    try:
        return file.execute("SELECT COUNT(*) FROM message").fetchone()[0]
    finally:
        file.close()


if __name__ == "__main__":
    typer.run(main)
