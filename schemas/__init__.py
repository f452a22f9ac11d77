"""What travels: the messages, their wire form, and the one table of topics."""
