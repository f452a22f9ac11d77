"""pipeline.learning.versions: what is in force, what is taken back, and what is never learned from."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.versions import Check, TwinVersions
from tests.support.learned_versions import DAY_NS, version


@pytest.fixture
def versions(tmp_path: Path) -> TwinVersions:
    return TwinVersions(tmp_path / "learned", "tray1")


def in_force(versions: TwinVersions) -> str:
    found = versions.in_force()
    return found.name if found else ""


def test_a_taken_version_is_in_force_and_an_offered_one_is_not_until_it_is_used(versions: TwinVersions) -> None:
    assert versions.next_name() == "tray1-1"
    assert versions.change_id == 0
    versions.add(version("tray1-1", 2))
    changed = versions.change_id
    versions.add(version("tray1-2", 3, outcome="offered"))
    assert versions.change_id != changed
    assert in_force(versions) == "tray1-1"
    assert versions.next_name() == "tray1-3"
    versions.use("tray1-2")
    assert in_force(versions) == "tray1-2"
    assert [each.name for each in TwinVersions(versions.folder, "tray1").all()] == ["tray1-1", "tray1-2"]


def test_a_version_that_learned_from_a_faulty_day_is_taken_back_to_the_newest_that_did_not(
    versions: TwinVersions,
) -> None:
    for number, day in enumerate((2, 3, 4), 1):
        versions.add(version(f"tray1-{number}", day))
    assert versions.mark_faulty((5 * DAY_NS, 6 * DAY_NS)) == ("", "")
    assert in_force(versions) == "tray1-3"
    assert versions.mark_faulty((2 * DAY_NS, 3 * DAY_NS)) == ("tray1-3", "tray1-1")
    assert in_force(versions) == "tray1-1"
    assert (2 * DAY_NS, 3 * DAY_NS) in versions.read().excluded_spans
    assert versions.mark_faulty((DAY_NS, DAY_NS + 1)) == ("tray1-1", ""), "it stays where there is no other"
    assert versions.read().is_tainted


def test_of_changed_fans_nothing_is_learned_until_their_version_is_used_and_then_nothing_from_before(
    versions: TwinVersions,
) -> None:
    versions.add(version("tray1-1", 2))
    since = 3 * DAY_NS
    spans = ((since, since + 5),)
    found = Check(t_ns=since + 5, reference="tray1-1", change=(0.04, 0.04), found="all fans are faster", spans=spans)
    versions.add_check(found)
    versions.add(version("tray1-2", 4, outcome="offered", since_t_ns=since, learned_spans=spans))
    later = (since + 10, since + 20)
    versions.add_check(found.model_copy(update={"spans": (*spans, later)}))
    assert later in versions.read().excluded_spans
    assert (since, since + 5) in versions.read().excluded_spans
    versions.use("tray1-2")
    assert (since, since + 5) not in versions.read().excluded_spans
    assert later not in versions.read().excluded_spans
    assert (0, since - 1) in versions.read().excluded_spans


def test_an_offer_waits_until_it_is_used_or_the_fans_are_as_they_were(versions: TwinVersions) -> None:
    versions.add(version("tray1-1", 2))
    found = Check(t_ns=3, reference="tray1-1", change=(0.04, 0.04), found="all fans are faster", spans=((1, 2),))
    versions.add_check(found)
    assert versions.read().waiting is None
    versions.add(version("tray1-2", 4, outcome="offered"))
    waiting = versions.read().waiting
    assert waiting
    assert waiting.name == "tray1-2"
    versions.add_check(found.model_copy(update={"found": "", "spans": ()}))
    assert versions.read().waiting is None
    versions.add_check(found)
    versions.use("tray1-2")
    assert versions.read().waiting is None


def test_an_unknown_version_and_a_damaged_list_are_refused_in_one_line(versions: TwinVersions) -> None:
    with pytest.raises(UserError, match="no version 'x'; there are none yet"):
        versions.use("x")
    versions.add(version("tray1-1", 2))
    with pytest.raises(UserError, match="no version 'x'; there are tray1-1"):
        versions.use("x")
    (versions.folder / "versions.json").write_text("{", encoding="utf-8")
    with pytest.raises(UserError, match=r"versions\.json: cannot read the versions of the twin: .*; move it away"):
        versions.all()


def test_what_operators_do_while_a_version_is_made_is_kept(versions: TwinVersions) -> None:
    versions.add(version("tray1-1", 2))
    versions.add(version("tray1-2", 3))
    seen = versions.read()
    versions.use("tray1-1")
    with pytest.raises(UserError, match="tray1-3 is not used: tray1-1 was put in force while it was made"):
        versions.add(version("tray1-3", 4), seen)
    seen = versions.read()
    versions.mark_faulty((3 * DAY_NS, 3 * DAY_NS + 1))
    with pytest.raises(UserError, match="tray1-3 is not used: it was learned from a time that is marked as faulty"):
        versions.add(version("tray1-3", 4), seen)
    assert in_force(versions) == "tray1-1"


def test_one_version_is_made_at_a_time(versions: TwinVersions) -> None:
    with (
        versions.learning(),
        pytest.raises(UserError, match="another `fantwin twins learn` works here"),
        TwinVersions(versions.folder, "tray1").learning(),
    ):
        pass
    versions.folder.joinpath("tray1-1.onnx").write_bytes(b"")
    with versions.learning():
        assert versions.next_name() == "tray1-2", "never the name of a file that is there"


def test_a_faulty_day_does_not_bring_back_a_twin_from_before_an_accepted_change(versions: TwinVersions) -> None:
    since = 3 * DAY_NS
    versions.add(version("tray1-1", 2))
    versions.add(version("tray1-2", 4, outcome="offered", since_t_ns=since, learned_spans=((since, since + 5),)))
    versions.use("tray1-2")
    later = 9 * DAY_NS
    versions.add(version("tray1-3", 10, since_t_ns=since, learned_spans=((since, since + 5), (later, later + 5))))
    assert versions.mark_faulty((later, later + 1)) == ("tray1-3", "tray1-2")
    assert versions.mark_faulty((since, since + 1)) == ("tray1-2", "")
