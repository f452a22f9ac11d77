"""The documentation site: built without a warning, whole, and from files alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import fantwin

ROOT = Path(__file__).parents[1]
FETCHED = {"script": "src", "img": "src", "iframe": "src", "link": "href"}


class Page(HTMLParser):
    """What a browser fetches by itself when it shows the page, and the texts of the paragraphs."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.fetched: set[str] = set()
        self.paragraphs: list[str] = []
        self._is_in_paragraph = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched.add(dict(attrs).get(FETCHED.get(tag, ""), "") or "")
        if tag == "p":
            self._is_in_paragraph = True
            self.paragraphs.append("")

    def handle_endtag(self, tag: str) -> None:
        self._is_in_paragraph &= tag != "p"

    def handle_data(self, data: str) -> None:
        if self._is_in_paragraph:
            self.paragraphs[-1] += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`make site`: every page is in the navigation, and every link leads to a page and a heading."""
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Page]:
    return {str(path.relative_to(site)): Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}


def test_every_document_is_a_page_and_found_by_the_search(site: Path, pages: dict[str, Page]) -> None:
    documents = {str(path.relative_to(ROOT / "docs").with_suffix(".html")) for path in (ROOT / "docs").rglob("*.md")}
    assert documents == set(pages) - {"404.html"}
    index = (site / "search" / "search_index.json").read_text(encoding="utf-8")
    assert [name for name in documents if f'"location":"{name}' not in index] == []


def test_a_page_fetches_nothing_from_elsewhere(site: Path, pages: dict[str, Page]) -> None:
    assert [address for page in pages.values() for address in page.fetched if re.match(r"(\w+:)?//", address)] == []
    styles = [path.read_text(encoding="utf-8") for path in site.rglob("*.css")]
    assert styles and [found for style in styles for found in re.findall(r"url\(['\"]?(?:https?:)?//", style)] == []


def test_lists_and_tables_are_drawn_as_such(pages: dict[str, Page]) -> None:
    """Not as lines of a paragraph: Python's Markdown needs an empty line where others do not."""
    wrong = {
        name: [text for text in page.paragraphs if re.search(r"^(?:[-*|] |\d+\. )", text, re.MULTILINE)]
        for name, page in pages.items()
    }
    assert {name: texts for name, texts in wrong.items() if texts} == {}


def test_the_python_page_has_every_name_that_the_package_offers(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    shown = re.findall(r'<h2 id="fantwin\.(\w+)"', page)
    assert sorted(shown) == sorted(fantwin.__all__)
