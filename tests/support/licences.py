"""The licences of all that fantwin installs, as a page: `make licences`.

Names and versions come from the locks, licences from the metadata of what is installed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "LICENSES.md"
PARTS = {
    "requirements.lock": "A plain installation",
    "requirements-image.lock": "Added in the container image",
    "requirements-dev.lock": "Added for the other extras, tests and documents",
}
"""title of each lock in the page; a package is listed below the first lock that has it"""
LINUX = {"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix", "platform_machine": "x86_64"}
PYTHON = {"python_version": "3.11", "python_full_version": "3.11.0", "implementation_name": "cpython"}
HEAD = """# Licences of dependencies

fantwin itself is under the [Apache License 2.0](LICENSE). Its wheel holds one work of others: uPlot, under the MIT
licence (`pipeline/outputs/web/page/uPlot.LICENSE`). All else is installed beside it, under the licences below as each
package declares them. PyTorch and what only the benches race against are not listed: they are installed to compare
with. `make licences` writes this page from the locks.
"""


UNDECLARED = {"pysnmp": "BSD-2-Clause"}
"""licences that only the text of the package says"""


def locked(lock: str) -> Iterator[tuple[str, str]]:
    """Name and version of each package that a lock installs on Linux with Python 3.11."""
    for line in re.findall(r"^[a-z0-9].*?(?= *\\?$)", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE):
        found = Requirement(line)
        if not found.marker or found.marker.evaluate(LINUX | PYTHON | {"platform_python_implementation": "CPython"}):
            yield found.name, str(found.specifier).removeprefix("==")


def rows() -> Iterator[tuple[str, str, str]]:
    """Lock, name and version of each package, in the order of the page."""
    listed: set[str] = set()
    for lock in PARTS:
        packages = [each for each in locked(lock) if each[0] not in listed]
        listed |= {name for name, _ in packages}
        yield from ((lock, *each) for each in packages)


def licence(name: str) -> str:
    """What an installed package declares: an SPDX expression, else classifiers, else the first line of its text."""
    declared = metadata(name)
    classifiers = (words.split(" :: ")[-1] for words in declared.get_all("Classifier", []) if "License ::" in words)
    text, expression = ((declared.get_all(each) or [""])[0] for each in ("License", "License-Expression"))
    return expression or ", ".join(classifiers) or text.split("\n")[0] or UNDECLARED.get(name, "")


def page() -> str:
    """The page.

    Raises:
        PackageNotFoundError: a package of the locks is not installed.
    """
    text, part = HEAD, ""
    for lock, name, version in rows():
        if lock != part:
            text += f"\n## {PARTS[lock]}\n\n| package | version | licence |\n|---|---|---|\n"
            part = lock
        text += f"| {name} | {version} | {licence(name)} |\n"
    return text


if __name__ == "__main__":
    try:
        PAGE.write_text(page(), encoding="utf-8")
    except PackageNotFoundError as missing:
        sys.exit(f"{missing.name} is not installed: run `make test` once, which installs all")
