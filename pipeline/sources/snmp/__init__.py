"""Fans of switches, cooling units and power units by SNMP."""
