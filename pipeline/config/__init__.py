"""The configuration file and the registry of stages."""
