"""The documents: every link leads somewhere, no paragraph is too long, and together they can be read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted((*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "examples").rglob("*.md")))
MOST_WORDS_OF_A_PARAGRAPH = 90
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)


def prose(page: Path) -> str:
    """The text of a page without its blocks of code."""
    return _FENCE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """What a link to a heading of the page may say after `#`, as GitHub makes it of the heading."""
    titles = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def paragraphs(page: Path) -> Iterator[str]:
    """The paragraphs and the items of lists; tables, headings and code are none."""
    for block in re.split(r"\n\s*\n", prose(page)):
        if not block.startswith(("    ", "|", "#", "![", "<!--")):
            yield from re.split(r"\n(?=\s*(?:[-*]|\d+\.) )", block)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    broken: list[str] = []
    for link in _LINK.findall(prose(page).replace("\n", " ")):
        target, _, anchor = link.partition("#")
        file = (page.parent / target).resolve() if target else page
        if re.match(r"\w+:", link):
            continue
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_of_the_repository_that_a_page_names_is_there(page: Path) -> None:
    folders = {path.name for path in ROOT.iterdir() if path.is_dir()} - {"runs"}  # commands write there
    named = re.findall(r"`([a-z_]+/[a-z0-9_./-]*)`", prose(page))
    assert not [path for path in named if path.split("/")[0] in folders and not (ROOT / path).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_paragraph_is_longer_than_can_be_read_at_once(page: Path) -> None:
    long = [text[:60] for text in paragraphs(page) if len(text.split()) > MOST_WORDS_OF_A_PARAGRAPH]
    assert not long


def test_what_a_symptom_quotes_is_said_by_the_product() -> None:
    """Troubleshooting: words in the first column, which a reader searches for."""
    quoted = re.findall(
        r"^\| [^|]*?`([^`]*)`[^|]* \|", (DOCS / "how-to/troubleshooting.md").read_text("utf-8"), re.MULTILINE
    )
    folders = ("pipeline", "schemas", "scoring", "stages", "twin")
    product = " ".join(path.read_text("utf-8") for name in folders for path in (ROOT / name).rglob("*.py"))
    said = re.sub(r'"\s+f?"', "", product)  # a sentence goes on in the next line
    assert len(quoted) > 10 and [words for words in quoted if words not in said] == []
