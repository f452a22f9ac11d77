"""Packets of a producer by their sequence numbers, for tests of what counts losses."""

from __future__ import annotations

from collections.abc import Iterable

from fantwin.schemas.enums import Severity, StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import tray_key

KEY = tray_key("site", "tray", "alarm")
PRODUCER = "scorer-all-p"


def packet(sequence: int, producer: str = PRODUCER) -> Envelope:
    header = Header(producer, sequence, "tray")
    alarm = Alarm(
        header=header,
        fan=0,
        active=True,
        severity=Severity.ALARM,
        t_ns=0,
        onset_t_ns=0,
        residual_rad_s=0,
        residual_std_rad_s=0,
        message="",
    )
    return Envelope(KEY, "alarm", b"", 0, alarm)


def sequences(packets: Iterable[Envelope]) -> list[int]:
    return [p.message.header.sequence for p in packets]


def health(published: int, producer: str = PRODUCER) -> Health:
    return Health(
        header=Header(producer, 0, ""),
        stage="s",
        instance="all",
        status=StageStatus.OK,
        t_ns=0,
        uptime_s=0,
        outputs=(Output(key=KEY, published=published),),
    )
