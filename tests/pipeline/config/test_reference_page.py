"""docs/reference/configuration.md has every key, and is what the models say today."""

from pathlib import Path

from fantwin.pipeline.config.reference_page import page

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "configuration.md"


def test_the_page_is_what_the_models_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run `make reference`"
