"""From readings of a source to messages on the bus, and from commands on the bus to the source."""
