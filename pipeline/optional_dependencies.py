"""How to install an extra of fantwin: it is in no package index, so the command names the checkout."""

from __future__ import annotations


def how_to_install(extra: str = "") -> str:
    """One command, for an error that says what is missing. extra: `train`, `view` or `parquet`."""
    return f"in the checkout: .venv/bin/pip install -e '.{f'[{extra}]' if extra else ''}'"
