"""Commands of `fantwin` called in this process, as the command line calls them."""

from importlib import import_module

import typer
from typer.testing import CliRunner, Result

from pipeline.cli.main import COMMANDS
from pipeline.errors import UsageError, UserError


def fantwin(name: str, *arguments: object, typed: str | None = None) -> Result:
    """Run a command; the result has its exit code, standard output and exception. typed: what it reads."""
    module, _ = COMMANDS[name]
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command(name)(getattr(import_module(f"pipeline.cli.{module}"), module.rpartition(".")[2]))
    return CliRunner().invoke(app, [str(argument) for argument in arguments], input=typed)


def error_of(name: str, *arguments: object) -> str:
    """The one-line error of a command that must fail."""
    return _one_line_of(UserError, name, *arguments)


def usage_error_of(name: str, *arguments: object) -> str:
    """The same of a command that is called wrongly: the command line exits with 2."""
    return _one_line_of(UsageError, name, *arguments)


def _one_line_of(kind: type[UserError], name: str, *arguments: object) -> str:
    error = fantwin(name, *arguments).exception
    assert isinstance(error, kind), error
    assert "\n" not in str(error)
    return str(error)
