"""Extras of the installation: the modules of each, whether they are installed, and the command that installs them.

The command fits the way fantwin itself was installed: from a checkout, by pip or uv, or as a tool of pipx or uv.
"""

from __future__ import annotations

import json
import os
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from fantwin.pipeline.errors import UserError

EXTRAS: dict[str, tuple[str, ...]] = {
    "view": ("rerun", "PIL"),
    "report": ("matplotlib", "jinja2"),
    "devices": ("paho", "pymodbus", "sushy"),
    "outputs": ("apprise", "asyncua", "paho"),
    "logs": ("pyarrow", "pyulog", "rosbags"),
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
    """The command that adds a requirement, such as `torch` or `fantwin[view]`, to this installation."""
    origin = _origin()
    if origin.get("dir_info", {}).get("editable"):
        checkout = Path(unquote(urlsplit(origin["url"]).path))
        own = requirement.startswith("fantwin")
        what = f"-e {_quoted('.' + requirement.removeprefix('fantwin'))}" if own else _quoted(requirement)
        return f"in {checkout}: {_pip(checkout)} {what}"
    environment = Path(sys.prefix)
    if (environment / "pipx_metadata.json").exists():
        return f"pipx runpip {environment.name} install {_quoted(requirement)}"
    if (environment / "uv-receipt.toml").exists():
        return _uv_tool(requirement, origin)
    return f"{_pip()} {_quoted(requirement)}"


def _origin() -> dict[str, Any]:
    """The installer's record of where fantwin came from (PEP 610); that of a checkout if fantwin is not installed."""
    try:
        noted = distribution("fantwin").read_text("direct_url.json")
    except PackageNotFoundError:
        return {"url": Path(__file__).parents[1].as_uri(), "dir_info": {"editable": True}}
    return json.loads(noted) if noted else {}


def _pip(folder: Path | None = None) -> str:
    """The shortest `pip install` for this environment, as typed in `folder`; that of uv if there is no pip."""
    program = Path(sys.prefix) / "bin" / "pip"
    if not is_installed("pip"):
        return f"uv pip install --python {sys.executable}"
    if folder is not None and program.is_relative_to(folder):
        return f"{program.relative_to(folder)} install"
    is_active = os.environ.get("VIRTUAL_ENV") == sys.prefix
    return "pip install" if is_active else f"{program} install"


def require_torch(what: str) -> None:
    """Raise an error if `what` lacks PyTorch, which no extra brings.

    Raises:
        UserError: it is not installed.
    """
    if not is_installed("torch"):
        raise UserError(f"{what} needs PyTorch: {how_to_install('torch')}")


def _uv_tool(requirement: str, origin: dict[str, Any]) -> str:
    """The command for a tool of uv. uv replaces a tool as a whole, so fantwin is named again with its origin, and so is
    all that was installed with it."""
    receipt = tomllib.loads((Path(sys.prefix) / "uv-receipt.toml").read_text(encoding="utf-8"))
    before = receipt.get("tool", {}).get("requirements", [])
    extras = {extra for each in before if each["name"] == "fantwin" for extra in each.get("extras", ())}
    beside = [each["name"] for each in before if each["name"] != "fantwin"]
    if requirement.startswith("fantwin"):
        extras.add(requirement.removeprefix("fantwin[").removesuffix("]"))
    else:
        beside.append(requirement)
    of_extras = f"[{','.join(sorted(extras))}]" if extras else ""
    fantwin = _quoted(f"fantwin{of_extras}{_at(origin)}")
    return " ".join(["uv tool install", fantwin, *(f"--with {_quoted(each)}" for each in beside)])


def _at(origin: dict[str, Any]) -> str:
    """The origin as a requirement has it; empty if fantwin came from a registry."""
    vcs = origin.get("vcs_info")
    if vcs is None:
        return f" @ {origin['url']}" if origin else ""
    revision = vcs.get("requested_revision")
    return f" @ {vcs['vcs']}+{origin['url']}{f'@{revision}' if revision else ''}"


def _quoted(requirement: str) -> str:
    return f"'{requirement}'" if any(each in requirement for each in "[ ") else requirement
