"""docs/reference/configuration.md has every key, and is what the models say today."""

from pathlib import Path

from pipeline.config.loading import top_level
from pipeline.config.models import BusConfig, LauncherConfig, TrayConfig
from pipeline.config.reference_page import page
from pipeline.config.registry import STAGES

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "configuration.md"


def test_the_page_is_what_the_models_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run `make configuration`"


def test_every_key_is_described_and_has_a_type() -> None:
    models = [top_level(), BusConfig, LauncherConfig, TrayConfig, *(row.load().config for row in STAGES.values())]
    undescribed = [
        f"{model.__name__}.{key}"
        for model in models
        for key, field in model.model_fields.items()
        if not field.description and key not in ("bus", "launcher", "tray")
    ]
    assert not undescribed
    assert page().count("see below") == 2  # source, tacho
