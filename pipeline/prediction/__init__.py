"""The twin in use: its file, its run on the commands alone, and the torque balance beside it."""
