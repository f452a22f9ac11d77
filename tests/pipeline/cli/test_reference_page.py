"""docs/reference/commands.md has every command and option, and is what the commands say today."""

from pathlib import Path

from fantwin.pipeline.cli.reference_page import page

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "commands.md"


def test_the_page_is_what_the_commands_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run `make reference`"
