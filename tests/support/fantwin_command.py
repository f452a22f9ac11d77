"""Commands of `fantwin` called in this process, as the command line calls them."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from unittest.mock import patch

import typer
from typer.testing import CliRunner, Result

from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.cli.main import function_of
from fantwin.pipeline.errors import UsageError, UserError


def fantwin(name: str, *arguments: object, typed: str | None = None) -> Result:
    """Run a command; the result has its exit code, standard output and exception. typed: what it reads."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command(name)(function_of(name))
    return CliRunner().invoke(app, [str(argument) for argument in arguments], input=typed)


def as_typed(*words: object) -> subprocess.CompletedProcess[str]:
    """What a person sees who types `fantwin` and these words: exit code, output, and errors as lines.

    The command must come to its end by itself. One that runs until it is stopped needs a process of its own.
    """
    shown, said, code = io.StringIO(), io.StringIO(), 0
    line = ["fantwin", *map(str, words)]
    only_this = patch.object(command_line.app, "registered_commands", [])
    with patch.object(sys, "argv", line), only_this, redirect_stdout(shown), redirect_stderr(said):
        try:
            command_line.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return subprocess.CompletedProcess(line, code, shown.getvalue(), said.getvalue())


def error_of(name: str, *arguments: object, typed: str | None = None) -> str:
    """The one-line error of a command that must fail. typed: what it reads."""
    return _one_line_of(UserError, name, *arguments, typed=typed)


def usage_error_of(name: str, *arguments: object) -> str:
    """The same of a command that is called wrongly: the command line exits with 2."""
    return _one_line_of(UsageError, name, *arguments)


def _one_line_of(kind: type[UserError], name: str, *arguments: object, typed: str | None = None) -> str:
    error = fantwin(name, *arguments, typed=typed).exception
    assert isinstance(error, kind), error
    assert "\n" not in str(error)
    return str(error)
