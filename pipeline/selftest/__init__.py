"""`fantwin doctor selftest`: a site of its own with a simulated tray, and the faults that it must survive."""
