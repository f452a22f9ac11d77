"""`python -m fantwin` and the command `fantwin`: the command line."""

import signal


def main() -> None:
    """Run a command. Until it has been imported, Ctrl-C ends the process at once and without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started it wants SIGINT ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from fantwin.pipeline.cli.main import main as run  # noqa: PLC0415  it takes a while

    run()


if __name__ == "__main__":
    main()
