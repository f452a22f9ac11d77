"""Alarm states after OPC UA Part 9, and the events that people and machines read."""
