"""How to install an extra of fantwin: it is in no package index, so the command names the checkout."""

from __future__ import annotations

from importlib.util import find_spec


def how_to_install(extra: str = "") -> str:
    """One command, for an error that says what is missing. extra: of pyproject.toml, such as `train`."""
    return f"in the checkout: .venv/bin/pip install -e '.{f'[{extra}]' if extra else ''}'"


def is_installed(module: str) -> bool:
    """Whether a module of an extra is there, without importing it."""
    return find_spec(module) is not None
