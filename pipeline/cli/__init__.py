"""The command line: one command a file, in folders named like the groups of `fantwin --help`."""
