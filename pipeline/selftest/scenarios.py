"""The faults of a self-test. Each is a row: what it does to a running site, what fantwin promises, and what it saw.

A scenario returns what it saw, or raises `NotKept`. After each, the site must judge all fans again, and must not have
raised an alarm, because all fans are healthy.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.selftest.scratch_site import FANS, GO_ON_LIMIT_S, SITE, STAGES, TRAY, NotKept, ScratchSite
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import BY_NAME, tray_key

SILENCE = "no raw samples"
STALL_S = 8.0
FAR_AHEAD_S = 3600.0
NOISE_BYTES = 200_000
GARBAGE_MESSAGES = 2_000
STRANGERS = 10_000
STRANGERS_LIMIT_MB = 20.0
SMALL_DISK_BYTES = 64 << 20


@dataclass(frozen=True)
class Scenario:
    """A fault and its promise.

    Attributes:
        name: one word, as on the command line.
        promise: what fantwin promises, one line.
        run: does it to a site; returns what was seen.
        needs_own_site: it leaves traces that others must not see.
        needs_small_disk: the site's files lie on a disk of `SMALL_DISK_BYTES`, which only root may mount.
    """

    name: str
    promise: str
    run: Callable[[ScratchSite], str]
    needs_own_site: bool = False
    needs_small_disk: bool = False


def _require(condition: object, otherwise: str) -> None:
    if not condition:
        raise NotKept(otherwise)


def _stranger(site: ScratchSite) -> Publisher:
    return site.bus.publisher(tray_key(SITE, TRAY, "raw"), BY_NAME["raw"], type_name(Raw), "stranger")


def _forged(t_ns: int) -> Raw:
    """A raw sample that no device has sent."""
    return Raw(
        header=Header("stranger", 2**40, TRAY),
        fans=FANS,
        host_receive_t_ns=np.array([t_ns], np.int64),
        device_clock_us=np.array([2**31], np.uint32),
        device_sequence=np.array([2**31], np.uint32),
        command=np.ones((1, FANS)),
        speed_rad_s=np.zeros((1, FANS)),
    )


def _kills(site: ScratchSite) -> str:
    seen: list[str] = []
    for label in STAGES:
        old = site.process_id(label)
        os.kill(old, signal.SIGKILL)
        took_s = site.seconds_until_replaced(label, old)
        site.seconds_until_judged(after=f" after {label} was restarted")
        seen.append(f"{label} {took_s:.1f} s")
    return "back after " + ", ".join(seen)


def _hang(site: ScratchSite) -> str:
    label = "twin_integrator"
    old = site.process_id(label)
    os.kill(old, signal.SIGSTOP)
    try:
        return f"killed and restarted after {site.seconds_until_replaced(label, old):.0f} s"
    except NotKept:
        os.kill(old, signal.SIGCONT)
        raise


def _silence(site: ScratchSite) -> str:
    site.line.is_cut = True
    try:
        otherwise = f"the resampler did not report {SILENCE!r}"
        took_s = site.seconds_until(lambda: SILENCE in site.problem("resampler"), 20.0, otherwise)
    finally:
        site.line.is_cut = False
    return f"reported by the resampler after {took_s:.1f} s"


def _backlog(site: ScratchSite) -> str:
    site.line.is_held = True
    threading.Event().wait(STALL_S)
    site.line.is_held = False
    return f"judged again {site.seconds_until_judged():.1f} s after the line was back"


def _noise(site: ScratchSite) -> str:
    site.line.inject(bytes((index * 197 + index // 256 * 31) % 256 for index in range(NOISE_BYTES)))
    return f"{NOISE_BYTES:,} bytes of noise skipped; judged again after {site.seconds_until_judged():.1f} s"


def _garbage(site: ScratchSite) -> str:
    publisher = _stranger(site)
    lost = sum(site.watcher.losses().values())
    for _ in range(GARBAGE_MESSAGES):
        publisher.put(b"\xff\xfe no message")
    site.seconds_until_judged()
    more = sum(site.watcher.losses().values()) - lost
    _require(not more, f"counted as {more} losses of this site")
    return f"{GARBAGE_MESSAGES:,} undecodable messages, none counted as a loss"


def _far_ahead(site: ScratchSite) -> str:
    view = site.view("resampler")
    assert view
    _stranger(site).put(encode(_forged(view.health.t_ns + round(FAR_AHEAD_S * 1e9))))
    return f"refused; judging went on (the next hundred samples took {site.seconds_until_judged():.1f} s)"


def _second_owner(site: ScratchSite) -> str:
    for words in (("up",), ("up", "--only", "acquisition")):
        what = f"fantwin {' '.join(words)}"
        try:
            done = site.command(*words, *site.configured(), limit_s=GO_ON_LIMIT_S)
        except subprocess.TimeoutExpired as error:
            raise NotKept(f"a second `{what}` was not refused") from error
        _require(done.returncode == 1, f"a second `{what}` ended with exit code {done.returncode}, not 1")
        _require(done.stderr.count("\n") == 1, f"a second `{what}` printed {len(done.stderr.splitlines())} lines")
    return "a second site and a second acquisition were refused in one line each"


def _recording_deleted(site: ScratchSite) -> str:
    for path in site.run_folder.glob("*.active"):
        path.unlink()
    otherwise = "no recording file was there again"
    took_s = site.seconds_until(lambda: list(site.run_folder.glob("*.active")), 20.0, otherwise)
    return f"a recording file was there again after {took_s:.1f} s"


def _full_disk(site: ScratchSite) -> str:
    ballast = site.run_folder / "ballast"
    with ballast.open("wb", buffering=0) as file, suppress(OSError):  # until it is full
        while True:
            file.write(bytes(1 << 16))
    otherwise = "the recorder did not report the full disk"
    took_s = site.seconds_until(lambda: site.problem("recorder"), GO_ON_LIMIT_S, otherwise)
    reported = site.problem("recorder")
    site.seconds_until_judged(after=" while the disk was full")
    ballast.unlink()
    otherwise = "recording did not resume after room was made"
    again_s = site.seconds_until(lambda: not site.problem("recorder"), GO_ON_LIMIT_S, otherwise)
    return f"reported after {took_s:.1f} s ({reported}); recording resumed {again_s:.1f} s after room was made"


def _strangers(site: ScratchSite) -> str:
    before = {label: site.memory_bytes(label) for label in STAGES}
    publisher = _stranger(site)
    for number in range(STRANGERS):
        publisher.put(encode(replace(_forged(0), header=Header(f"stranger-{number}", 0, TRAY))))
    judged_s = site.seconds_until_judged()
    grown = max(site.memory_bytes(label) - before[label] for label in STAGES) / 1e6
    _require(grown < STRANGERS_LIMIT_MB, f"a stage grew by {grown:.0f} MB")
    return f"judged again {judged_s:.1f} s after {STRANGERS:,} messages; no stage grew by more than {grown:.0f} MB"


def _clock_back(site: ScratchSite) -> str:
    site.set_clock(-FAR_AHEAD_S)
    judged_s = site.seconds_until_judged()
    old = {label: site.process_id(label) for label in (STAGES[0], "resampler")}
    for process_id in old.values():
        os.kill(process_id, signal.SIGKILL)
    for label, process_id in old.items():
        site.seconds_until_replaced(label, process_id)
    again_s = site.seconds_until_judged(after=" after acquisition and resampler were restarted")
    return f"judged again after {judged_s:.1f} s, and {again_s:.1f} s after acquisition and resampler were restarted"


def _clock_forward(site: ScratchSite) -> str:
    site.set_clock(FAR_AHEAD_S)
    return f"judged again after {site.seconds_until_judged():.1f} s"


SCENARIOS = (
    Scenario("kill", "each stage that is killed is restarted, and judging goes on", _kills),
    Scenario("hang", "a stage that hangs is killed and restarted", _hang),
    Scenario("silence", "a silent line is reported", _silence),
    Scenario("backlog", f"a line that stalls {STALL_S:.0f} s and delivers its backlog raises no alarm", _backlog),
    Scenario("noise", "noise on the line is skipped", _noise),
    Scenario("garbage", "undecodable messages from other programs are not counted as losses of the site", _garbage),
    Scenario("far-ahead", "a forged message whose time is an hour ahead changes nothing", _far_ahead),
    Scenario(
        "strangers",
        "messages from ten thousand unknown producers neither delay the site nor fill its memory",
        _strangers,
    ),
    Scenario("second-owner", "a second owner of a site or a tray is refused", _second_owner),
    Scenario(
        "deleted", "a deleted recording is restored, or a new one is begun", _recording_deleted, needs_own_site=True
    ),
    Scenario(
        "full-disk",
        "a full disk is reported and does not stop judging; recording resumes once there is room",
        _full_disk,
        needs_own_site=True,
        needs_small_disk=True,
    ),
    Scenario(
        "clock-back",
        "judging goes on when the host clock is set back an hour, and when stages are killed after that",
        _clock_back,
        needs_own_site=True,
    ),
    Scenario(
        "clock-forward",
        "judging goes on when the host clock is set forward an hour",
        _clock_forward,
        needs_own_site=True,
    ),
)
