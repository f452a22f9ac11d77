"""Alarm clips: the recording of a tray from before an alarm to after it, kept until the alarm is acknowledged."""
