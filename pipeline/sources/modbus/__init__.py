"""Samples of drives and controllers that speak Modbus, over TCP or a serial line."""
