"""How stages run: bus, runner, health, configuration, launcher, recordings, command line."""
