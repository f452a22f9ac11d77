"""The words that were replaced stay gone: docs/architecture.md has the glossary of those in use.

Lines with FORMER are exempt: they name keys and suffixes of stored data that are still read.
"""

from __future__ import annotations

import io
import re
import subprocess
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RETIRED_NAMES = (
    *("Outlet", "keeper", "why_not", "WhyNot", "MemoryFile", "AlarmDesk", "StandingAlarm", "NotJudged"),
    *("WearWatch", "Suspect", "WhatIf", "WholeFile", "Census", "Reel", "Shelf", "disown", "restate", "beginnings"),
    *("safe_level", "made_up_config", "place_of", "NO_SNAPSHOT", "BROKEN", "farewell", "hand_over"),
    *("disowned", "restated", "linger", "said_instead", "Verdict", "Wording", "Lane", "Ledger", "Promise"),
)
RETIRED_WORDS = ("told", "tells", "anew", "mended", "mend", "mending", "torn", "lasting", "survey")
RETIRED_IDENTIFIERS = (  # plain English in a sentence, a private word as the name of a variable, function or class
    *("Inlet", "Judge", "Standing", "Course", "Walk", "Material", "Packet", "Entry", "Pending", "Made", "Head"),
    *("Account", "Cause", "Distance", "Line", "Running", "FAR", "LEAST", "MORE", "WILD", "PATIENCE"),
    *("usual", "quiet", "worth", "carried", "doubt", "meet"),
)
FOLDERS = (
    "fantwin_client",
    "schemas",
    "scoring",
    "pipeline",
    "simulation",
    "stages",
    "twin",
    "bench",
    "tests",
    "docs",
    "README.md",
)
KEPT = {
    "tests/test_vocabulary.py",  # lists them
}


@cache
def tracked_texts() -> dict[str, str]:
    """Every tracked source and document, by its path; generated code and tables of former names apart."""
    names = subprocess.run(
        ["git", "ls-files", "--", *FOLDERS], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    texts = {
        name: (ROOT / name).read_text()
        for name in names
        if name.endswith((".py", ".md", ".proto", ".toml", ".sh", ".html"))
        and name not in KEPT
        and "fan_pb2" not in name
        and "former" not in name
    }
    return texts or pytest.skip("not a git checkout")


@cache
def identifiers() -> dict[str, list[str]]:
    """Where each name is used in Python code, apart from comments and strings."""
    places: dict[str, list[str]] = {}
    for path, text in tracked_texts().items():
        if path.endswith(".py"):
            for token in tokenize.generate_tokens(io.StringIO(text).readline):
                if token.type == tokenize.NAME:
                    places.setdefault(token.string, []).append(f"{path}:{token.start[0]}: {token.line.strip()}")
    return places


@pytest.mark.parametrize("word", [*RETIRED_NAMES, *RETIRED_WORDS])
def test_a_word_that_was_replaced_is_gone_from_code_and_documents(word):
    pattern = re.compile(rf"(?<![A-Za-z0-9_]){word}(?![A-Za-z0-9_])")
    found = [
        f"{path}:{number}: {line.strip()}"
        for path, text in tracked_texts().items()
        for number, line in enumerate(text.splitlines(), start=1)
        if pattern.search(line) and "FORMER" not in line
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", RETIRED_IDENTIFIERS)
def test_a_name_that_was_replaced_is_no_identifier(name):
    found = identifiers().get(name, [])
    assert not found, "\n".join(found)
