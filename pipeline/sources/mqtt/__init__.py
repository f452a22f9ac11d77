"""Samples from an MQTT broker."""
