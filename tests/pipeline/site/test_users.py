"""Passwords that are taken."""

from __future__ import annotations

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.users import checked_password


@pytest.mark.parametrize("password", ["correct horse battery", "ann likes 12 fans", "ünïcödé wörds", "aBc1 " * 12])
def test_any_characters_make_a_password_as_they_are(password):
    assert checked_password(password, "ann") == password


@pytest.mark.parametrize(
    ("password", "why"),
    [
        ("elevenchars", "11 characters"),
        ("x" * 129, "129 characters"),
        ("Fantwin-Operator-Ann", "easy to guess"),
        ("AdminPassword1", "easy to guess"),
        ("aaaaaaaaaaaaaaaaaaaa", "easy to guess"),
    ],
)
def test_what_is_too_short_or_made_of_words_that_are_guessed_is_refused(password, why):
    with pytest.raises(UserError, match=why):
        checked_password(password, "ann")
