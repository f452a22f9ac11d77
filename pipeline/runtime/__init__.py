"""How a stage runs: the stage contract, the runner, its clock, its health and its snapshots."""
