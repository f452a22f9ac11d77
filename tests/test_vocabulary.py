"""The words that were replaced stay gone: docs/architecture.md has the glossary of those in use."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RETIRED_NAMES = (
    *("Outlet", "keeper", "why_not", "WhyNot", "MemoryFile", "AlarmDesk", "StandingAlarm", "NotJudged"),
    *("WearWatch", "Suspect", "WhatIf", "WholeFile", "Census", "Reel", "Shelf", "disown", "restate", "beginnings"),
    *("safe_level", "made_up_config", "place_of", "NO_SNAPSHOT", "BROKEN", "motion_rad_s", "farewell", "hand_over"),
)
RETIRED_WORDS = ("told", "anew", "mended", "mend")
FOLDERS = ("schemas", "scoring", "pipeline", "simulation", "stages", "twin", "bench", "tests", "docs", "README.md")
KEPT = {
    "tests/test_vocabulary.py",  # lists them
}


def tracked_texts() -> dict[str, str]:
    """Every tracked source and document, by its path; generated code and tables of former names apart."""
    names = subprocess.run(
        ["git", "ls-files", "--", *FOLDERS], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    return {
        name: (ROOT / name).read_text()
        for name in names
        if name.endswith((".py", ".md", ".proto", ".toml", ".sh", ".html"))
        and name not in KEPT
        and "fan_pb2" not in name
        and "former" not in name
    }


@pytest.mark.parametrize("word", [*RETIRED_NAMES, *RETIRED_WORDS])
def test_a_word_that_was_replaced_is_gone_from_code_and_documents(word):
    texts = tracked_texts()
    if not texts:
        pytest.skip("not a git checkout")
    pattern = re.compile(rf"(?<![A-Za-z0-9_]){word}(?![A-Za-z0-9_])")
    found = [
        f"{name}:{number}: {line.strip()}"
        for name, text in texts.items()
        for number, line in enumerate(text.splitlines(), start=1)
        if pattern.search(line) and "FORMER" not in line
    ]
    assert not found, "\n".join(found)
