"""docs/how-to: each configuration that a page shows is one, and its sources can be built."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from fantwin.pipeline.config.json_schema import schema_text
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import ConfigError
from fantwin.pipeline.sources.kinds import SOURCE_KINDS, build_source
from fantwin.pipeline.sources.source import SourceContext

ROOT = Path(__file__).parents[3]
PAGES = {page.stem: page.read_text(encoding="utf-8") for page in (ROOT / "docs/how-to").glob("*.md")}
SHOWN = [
    pytest.param(block, id=f"{name}-{number}")
    for name, text in sorted(PAGES.items())
    for number, block in enumerate(re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE), start=1)
]
SCHEMA_FILE = ROOT / "docs/reference/fantwin.schema.json"
SCHEMA = Draft202012Validator(json.loads(SCHEMA_FILE.read_text(encoding="utf-8")))
TRAYS = "".join(f'[[tray]]\nname = "tray{number}"\nfans = 2\n' for number in (1, 2, 3, 4))


@pytest.mark.parametrize("block", SHOWN)
def test_a_configuration_of_a_how_to_is_one(block: str) -> None:
    table = tomllib.loads(block)
    text = block if "tray" in table else block + TRAYS
    SCHEMA.validate(tomllib.loads(text))
    config = parse_config(text, Path("fantwin.toml"), stages=STAGES.keys() & table.keys())
    for tray in config.trays if "tray" in table else ():
        assert build_source(tray.source, SourceContext(tray.fans, tray.speed_unit, Path())).name


def test_the_page_of_sources_has_every_kind_of_source() -> None:
    assert all(f"| `{kind}` |" in PAGES["sources"] for kind in SOURCE_KINDS)


def test_the_schema_for_editors_is_that_of_the_models_and_knows_all_shipped_configurations() -> None:
    assert SCHEMA_FILE.read_text(encoding="utf-8") == schema_text(), "run `make reference`"
    Draft202012Validator.check_schema(SCHEMA.schema)
    files = [path for of in ("deploy", "examples", "firmware", "pipeline") for path in (ROOT / of).rglob("*.toml")]
    shipped = [path for path in files if "[[tray]]" in path.read_text(encoding="utf-8")]
    assert shipped
    for path in shipped:
        SCHEMA.validate(tomllib.loads(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ('[[tray]]\nname = "a"\nport = "x"\n', ["tray", 0]),
        ('[[tray]]\nname = "a"\nfans = 0\n', ["tray", 0, "fans"]),
        ('[[tray]]\nname = "a"\nfans = 1\nsource = { kind = "hwmom" }\n', ["tray", 0, "source"]),
        ('[[tray]]\nname = "a"\nfans = 1\nsource = { kind = "hwmon", port = "x" }\n', ["tray", 0, "source"]),
        (f'{TRAYS}[gateway]\nport = "none"\n', ["gateway", "port"]),
        (f"{TRAYS}[gatway]\n", []),
    ],
)
def test_an_editor_marks_what_the_doctor_refuses(text: str, where: list[str | int]) -> None:
    with pytest.raises(ConfigError):
        parse_config(text, Path("fantwin.toml"))
    assert where in [list(each.absolute_path) for each in SCHEMA.iter_errors(tomllib.loads(text))]
