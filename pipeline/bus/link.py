"""The link between a client and its router."""

LEASE_MS = "4000"
"""after this long without a sign of life, either end considers the connection dead, and a client opens a new one. With
Zenoh's 10 s, a container that was cut off for 6 s came back 10 s later. Peers keep those 10 s: on one host no link is
lost, and a stage that is suspended for a while must not be cut off."""
