"""Extras of the installation: the modules of each, whether they are installed, and the command that installs them."""

from __future__ import annotations

import os
import shlex
import sys
from importlib.util import find_spec

from fantwin.pipeline.errors import UserError

EXTRAS: dict[str, tuple[str, ...]] = {
    "view": ("rerun",),
    "report": ("matplotlib", "jinja2"),
    "devices": ("paho", "pymodbus", "pysnmp"),
    "outputs": ("apprise", "asyncua", "paho"),
    "logs": ("pyarrow", "pyulog", "rosbags", "ruamel"),
    "remote": ("distributed", "fsspec", "s3fs"),
}
"""extra of pyproject.toml -> those of its modules that the code imports"""


def is_installed(module: str) -> bool:
    """Whether a module is installed; it is not imported."""
    try:
        return find_spec(module) is not None
    except ValueError:  # an entry None of sys.modules
        return False


def missing_extra(what: str, extra: str, *modules: str) -> str:
    """One line that says that `what` needs an extra and how to install it; empty if it is installed.

    modules: the modules of the extra that are needed; without them, all.
    """
    if all(map(is_installed, modules or EXTRAS[extra])):
        return ""
    return f"{what} needs the extra `{extra}`: {how_to_install(f'fantwin[{extra}]')}"


def require(what: str, extra: str, *modules: str) -> None:
    """Raise an error if `what` lacks its extra, see `missing_extra`.

    Raises:
        UserError: the extra is not installed.
    """
    if problem := missing_extra(what, extra, *modules):
        raise UserError(problem)


def how_to_install(requirement: str) -> str:
    """The command that adds a requirement, such as `torch` or `fantwin[view]`, to the environment of this process.

    fantwin itself stays as it is, wherever it came from: an extra adds the packages that its metadata names.
    """
    if not is_installed("pip"):  # as in the environments of uv
        program = f"uv pip install --python {sys.executable}"
    else:
        is_active = os.environ.get("VIRTUAL_ENV") == sys.prefix
        program = "pip install" if is_active else f"{sys.executable} -m pip install"
    return f"{program} {shlex.quote(requirement)}"


def require_torch(what: str) -> None:
    """Raise an error if `what` lacks PyTorch, which no extra brings.

    Raises:
        UserError: it is not installed.
    """
    if not is_installed("torch"):
        raise UserError(f"{what} needs PyTorch: {how_to_install('torch')}")
