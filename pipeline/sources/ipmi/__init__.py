"""Fans that a baseboard controller shows by IPMI, read by ipmitool."""
