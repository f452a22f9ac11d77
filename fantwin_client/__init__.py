"""Push the samples of fans to fantwin over its bus, from any Python program.

    import fantwin_client

    with fantwin_client.connect("tcp/127.0.0.1:7447", site="plant") as client:
        tray = client.tray("tray1", speed_unit="rpm")
        tray.publish(time.time(), command=[0.4, 0.6], speed=[1490.0, 2210.0])
        print(tray.losses())

The tray must have `source = { kind = "push" }` in the configuration of the site. docs/how-to/sources.md has more.
"""

from __future__ import annotations

from fantwin_client.client import Client, connect
from fantwin_client.errors import (
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
from fantwin_client.losses import Losses
from fantwin_client.tray import Tray

__all__ = [
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
