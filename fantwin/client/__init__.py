"""Push the samples of fans to fantwin over its bus, from any Python program.

    import fantwin

    with fantwin.connect("tcp/127.0.0.1:7447", site="plant") as client:
        tray = client.tray("tray1", speed_unit="rpm")
        tray.publish(time.time(), command=[0.4, 0.6], speed=[1490.0, 2210.0])
        print(tray.losses())

The tray must have `source = { kind = "push" }` in the configuration of the site. docs/how-to/sources.md has more.
"""

from __future__ import annotations

from fantwin.client.client import Client, connect
from fantwin.client.errors import (
    ClientError,
    CommandError,
    FanCountError,
    NoAcquisitionError,
    NotAllowedError,
    NotKeptError,
    NotReceivedError,
    SamplesLostError,
    SendError,
    TimeOrderError,
)
from fantwin.client.losses import Losses
from fantwin.client.tray import Tray
from fantwin.pipeline.bus.errors import BusError

__all__ = [
    "BusError",
    "Client",
    "ClientError",
    "CommandError",
    "FanCountError",
    "Losses",
    "NoAcquisitionError",
    "NotAllowedError",
    "NotKeptError",
    "NotReceivedError",
    "SamplesLostError",
    "SendError",
    "TimeOrderError",
    "Tray",
    "connect",
]
