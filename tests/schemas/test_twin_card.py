"""schemas.twin_card: one definition for maker and runtime, which needs no heavy library."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fantwin import pipeline
from fantwin.pipeline.prediction.tray_twin import read_onnx_metadata
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.twin_card import CARD_PROPERTY, CardError, TwinCard
from fantwin.twin.models.physical import PhysicalModel
from tests.support.twin_files import made_up_card

DEMO_TWIN = Path(pipeline.__file__).parent / "demo" / "twin.onnx"
GOLDEN = Path(__file__).parents[1] / "support" / "data" / "golden.mcap"


def test_fields_of_a_later_card_are_ignored_and_its_kind_needs_not_be_known() -> None:
    later = json.loads(made_up_card(PhysicalModel(), 1).to_json()) | {"kind": "of tomorrow", "more": 1}
    assert TwinCard.from_json(json.dumps(later)).kind == "of tomorrow"


def test_the_tacho_is_one_for_all_fans_or_one_for_each() -> None:
    fields = json.loads(made_up_card(PhysicalModel(), 2).to_json())
    slow, fast = ({"kind": "count", "window_s": window_s} for window_s in (1.0, 0.5))

    def windows_s(tacho: object) -> list[float]:
        card = TwinCard.from_json(json.dumps(fields | {"tacho": tacho}))
        assert TwinCard.from_json(card.to_json()) == card
        return [tacho.window_s for tacho in card.tacho_of_each_fan]

    assert windows_s(slow) == windows_s([slow]) == [1.0, 1.0]
    assert windows_s([slow, fast]) == [1.0, 0.5]
    with pytest.raises(CardError, match="3 tachos for 2 fans"):
        windows_s([slow, fast, fast])


def test_the_twin_of_the_demo_and_the_card_in_the_golden_recording_are_read() -> None:
    demo = TwinCard.from_json(read_onnx_metadata(DEMO_TWIN.read_bytes())[CARD_PROPERTY])
    assert (demo.kind, demo.fans, demo.fixed_rate) == ("hybrid", 8, False)
    cards = [entry.message for entry in read_recording(GOLDEN) if isinstance(entry.message, ModelCard)]
    assert cards
    assert all(TwinCard.from_json(card.card_json).calibration for card in cards)


def test_reading_a_card_loads_no_heavy_library() -> None:
    program = (
        "import sys; from pathlib import Path; from fantwin.pipeline.prediction.tray_twin import load_tray_twin; "
        f"load_tray_twin(Path({str(DEMO_TWIN)!r})); "
        "print([name for name in ('torch', 'onnx', 'onnxruntime', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
