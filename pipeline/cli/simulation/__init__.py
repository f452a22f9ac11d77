"""Commands that simulate a tray."""
