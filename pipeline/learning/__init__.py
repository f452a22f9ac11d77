"""How a tray without a twin gets one while it runs: its healthy history, the versions of its twin, when to learn."""
