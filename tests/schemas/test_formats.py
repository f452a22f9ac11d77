"""Format numbers: what is refused, and with which line."""

from __future__ import annotations

import pytest

from fantwin.schemas.formats import CONFIGURATION, RECORDING, SNAPSHOT, TWIN_CARD, Format

FORMATS = pytest.mark.parametrize("kind", [RECORDING, TWIN_CARD, SNAPSHOT, CONFIGURATION], ids=lambda kind: kind.kind)


@FORMATS
def test_what_this_version_writes_it_reads(kind: Format) -> None:
    assert kind.refusal(kind.written) == ""


@FORMATS
@pytest.mark.parametrize("found", [0, None, True, "1", 1.5, -1])
def test_another_number_is_refused_with_what_to_do(kind: Format, found: object) -> None:
    line = kind.refusal(found)
    assert kind.kind in line and line.endswith(f"this fantwin reads format {kind.written}: {kind.advice}")
    assert ("without a format number" in line) if found is None else (repr(found) in line)


@FORMATS
def test_a_newer_number_is_refused_with_the_advice_to_update(kind: Format) -> None:
    newer, known = kind.written + 1, kind.written
    assert kind.refusal(newer) == f"{kind.kind} of format {newer}; this fantwin reads format {known}: update fantwin"
