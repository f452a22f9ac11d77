"""The log of logins and refusals: what is written when there is too much."""

from __future__ import annotations

import json

from fantwin.pipeline.site.security_log import MOST_LINES, WITHIN_S, SecurityLog


def test_a_flood_is_counted_and_left_out_and_the_next_minute_says_how_much():
    lines: list[str] = []
    now_s = 0.0
    log = SecurityLog(lines.append, lambda: now_s)
    for number in range(MOST_LINES + 500):
        log.add("login refused", user=f"\x1b[31muser{number}\n" + "x" * 1000)
    assert len(lines) == MOST_LINES
    assert all(line.isascii() and line.isprintable() and len(line) < 600 for line in lines)
    now_s += WITHIN_S
    log.add("login", user="ann")
    last = json.loads(lines[-1].removeprefix("event: "))
    assert (last["what"], last["user"], last["events_left_out_before"]) == ("login", "ann", "500")
