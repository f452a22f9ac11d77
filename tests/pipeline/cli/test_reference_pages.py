"""docs/reference: topics, values of bounds and keys of a scenario are those of the code."""

from pathlib import Path

import pytest

from fantwin.pipeline.cli.reference_pages import MADE, PAGES, with_topics, with_values

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(("page", "made"), MADE.items())
def test_the_tables_are_those_of_the_code(page, made) -> None:
    text = (ROOT / PAGES / page).read_text(encoding="utf-8")
    assert text == made(text), "run `make reference`"


def test_a_bound_gets_its_value_and_the_unit_of_its_name() -> None:
    row = "| `runtime.inbox.{}` | 7 | publishers wait |"
    assert with_values(row.format("INBOX_BYTES")) == "| `runtime.inbox.INBOX_BYTES` | 128 MiB | publishers wait |"
    with pytest.raises(AttributeError):
        with_values(row.format("NO_SUCH_BOUND"))


def test_the_table_of_topics_says_who_writes_and_who_reads() -> None:
    page = with_topics("# Messages\n\n| topic | of another time |\n|---|\n\nmore\n")
    assert "| `grid` | `Grid` | samples on a uniform grid | resampler | twin_integrator, recorder |" in page
    assert page.endswith("\n\nmore\n") and "of another time" not in page
