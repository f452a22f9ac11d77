"""`python -m pipeline` is the command line: how the launcher starts stages."""

from pipeline.cli.main import main

main()
