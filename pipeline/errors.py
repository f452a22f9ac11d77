"""Errors that the user can correct."""

from __future__ import annotations

from collections.abc import Callable


class FantwinError(Exception):
    """Error that a user can correct: one line that says what is wrong, where, and what to do."""


FantwinError.__module__ = "fantwin"  # as it is imported, and as a traceback shows it


class UserError(FantwinError):
    """One line that says what is wrong, where, and what to do; the command line prints it and exits 1."""


class UsageError(UserError):
    """The command line is wrong by itself or for its configuration, whatever files and sites hold; it exits 2."""


def refusals(*attempts: Callable[[], object]) -> list[str]:
    """What is wrong with those that end with a UserError, a line each."""
    found: list[str] = []
    for attempt in attempts:
        try:
            attempt()
        except UserError as error:
            found.append(str(error))
    return found
