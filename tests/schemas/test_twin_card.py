"""schemas.twin_card: one definition for maker and runtime, which reads earlier forms and needs no heavy library."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import pipeline
from pipeline.recordings.reading import read_recording
from pipeline.runtime.onnx_metadata import read_onnx_metadata
from schemas.messages import ModelCard
from schemas.twin_card import CARD_PROPERTY, CardError, TwinCard
from tests.support.twin_files import made_up_card, small_hybrid
from twin.models.physical import PhysicalModel

DEMO_TWIN = Path(pipeline.__file__).parent / "demo" / "twin.onnx"
GOLDEN = Path(__file__).parents[1] / "support" / "data" / "golden.mcap"


def test_a_card_survives_conversion_to_json_and_back() -> None:
    card = made_up_card(small_hybrid(), 3)
    assert TwinCard.from_json(card.to_json()) == card


@pytest.mark.parametrize(
    ("kind", "fixed_rate", "used"),
    [("hybrid", False, 4), ("physical", False, 4), ("neural-ode", False, 1), ("narx", True, 0)],
)
def test_fields_missing_from_early_cards_follow_from_their_kind(kind: str, fixed_rate: bool, used: int) -> None:
    early = asdict(made_up_card(PhysicalModel(), 1)) | {"kind": kind}
    del early["fixed_rate"], early["used_parameters"]
    card = TwinCard.from_json(json.dumps(early))
    assert (card.fixed_rate, len(card.used_parameters)) == (fixed_rate, used)


def test_standard_errors_of_early_cards_become_a_covariance_without_correlations() -> None:
    early = asdict(made_up_card(PhysicalModel(), 1))
    del early["balance"]["covariance"]
    early["balance"]["std_errors"] = [[0.1, 0.2, 0.3, 0.4]]
    covariance = TwinCard.from_json(json.dumps(early)).balance.covariance
    np.testing.assert_allclose(covariance[0], np.diag(np.square([0.1, 0.2, 0.3, 0.4])))


def test_fields_of_a_later_card_are_ignored_and_its_kind_needs_not_be_known() -> None:
    later = asdict(made_up_card(PhysicalModel(), 1)) | {"kind": "of tomorrow", "more": 1}
    assert TwinCard.from_json(json.dumps(later)).kind == "of tomorrow"


def test_a_card_of_an_unknown_kind_must_state_the_fields_that_an_early_kind_implies() -> None:
    later = asdict(made_up_card(PhysicalModel(), 1)) | {"kind": "of tomorrow"}
    del later["fixed_rate"]
    with pytest.raises(CardError, match="fixed_rate"):
        TwinCard.from_json(json.dumps(later))


def test_the_twin_of_the_demo_and_the_card_in_the_golden_recording_are_read() -> None:
    demo = TwinCard.from_json(read_onnx_metadata(DEMO_TWIN.read_bytes())[CARD_PROPERTY])
    assert (demo.kind, demo.fans, demo.fixed_rate) == ("hybrid", 8, False)
    cards = [entry.message for entry in read_recording(GOLDEN) if isinstance(entry.message, ModelCard)]
    assert cards
    assert all(TwinCard.from_json(card.card_json).calibration for card in cards)


def test_reading_a_card_loads_no_heavy_library() -> None:
    program = (
        "import sys; from pathlib import Path; from pipeline.runtime.tray_twin import load_tray_twin; "
        f"load_tray_twin(Path({str(DEMO_TWIN)!r})); "
        "print([name for name in ('torch', 'onnx', 'onnxruntime', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
