"""The link between a client and its router."""

LEASE_MS = "4000"
"""after this long without a sign of life, either end considers the connection dead, and a client opens a new one. With
Zenoh's 10 s, a container that was cut off for 6 s came back 10 s later. Peers keep those 10 s: on one host no link is
lost, and a stage that is suspended for a while must not be cut off."""
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""when a connection that failed or was lost is tried again"""
OPEN_TIMEOUT_MS = 3000
"""after this long without an answer a client that has lost its router tries the next one. With Zenoh's 10 s, clients of
a router whose host had vanished found the other one after 14 s."""
PEER_WAIT_US = 9_000_000
"""a peer that takes nothing for so long is cut off; it is back when it and the others have met again
(`Bus.meet_again`). With Zenoh's 5 s a stage that was suspended for 8 s was cut off. The watchdog's limit is beyond it:
who sends lives on."""
