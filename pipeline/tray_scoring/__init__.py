"""The scorer of a tray: its healthy model from the twin, versions of a learned twin, snapshots."""
