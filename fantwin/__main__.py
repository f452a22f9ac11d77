"""`python -m fantwin` is the command line: how the launcher starts stages."""

from fantwin.pipeline.cli.main import main

main()
