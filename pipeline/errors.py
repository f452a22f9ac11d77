"""Errors that the user can correct."""


class UserError(Exception):
    """One line that says what is wrong, where, and what to do; the command line prints it and exits 1."""


class UsageError(UserError):
    """The command line is wrong by itself or for its configuration, whatever files and sites hold; it exits 2."""
