"""The link between a client and its router."""

LEASE_MS = "4000"
"""after so long without a sign of life, either end takes a connection for dead and a client makes a new one. With
Zenoh's 10 s, a container that was cut off for 6 s came back 10 s later. Peers keep those 10 s: on one host no link is
lost, and a stage that is stopped for a while must not be cut off."""
