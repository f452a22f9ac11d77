"""Identifiers of the nodes: numbers for what exists once, `TRAY/FAN/...` for what a site has."""

from __future__ import annotations

from fantwin.pipeline.site.fleet import Fan

NAMESPACE = "urn:fantwin:fans"
SITE_FOLDER, FAN_TYPE, FAN_ALARM_TYPE, COMMISSION, COMMISSION_ARGUMENTS = 1, 2, 3, 4, 5
ALARM, SHELVING_STATE = "Alarm", "Alarm/ShelvingState"


def condition_identifier(fan: Fan) -> str:
    """Of the node of a fan's condition."""
    return f"{fan}/{ALARM}"


def fan_of(identifier: object) -> tuple[Fan, str] | None:
    """The fan of a node and the path below it, empty for the fan itself; None: the node is of no fan."""
    if not isinstance(identifier, str):
        return None
    tray, _, rest = identifier.partition("/")
    number, _, path = rest.partition("/")
    if not (number.isascii() and number.isdigit() and len(number) < 6 and str(int(number)) == number):
        return None
    return Fan(tray, int(number)), path
