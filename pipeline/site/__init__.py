"""The site now: its stages, its fans and their alarms, the history of alarms, users and their requests."""
