"""`python -m pipeline` is the command line: how the launcher starts stages."""

from pipeline.command_line import main

main()
