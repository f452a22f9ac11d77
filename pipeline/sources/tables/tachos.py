"""How the speeds of a table or a log were measured, as a user writes it."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import ValidationError

from fantwin.pipeline.errors import UsageError
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan


def parse_tachos(given: Sequence[str], fans: int) -> tuple[Tacho, ...]:
    """The tachos that texts such as `count:window_s=1,pulses=2` describe: one for all fans, or one for each.

    Raises:
        UsageError: one is not possible, or they are of another number of fans.
    """
    tachos: list[Tacho] = []
    for text in given:
        kind, _, settings = text.partition(":")
        pairs = [setting.partition("=") for setting in settings.split(",") if setting]
        try:
            tachos.append(Tacho.model_validate({"kind": kind, **{key: value for key, _, value in pairs}}))
        except ValidationError as error:
            first = error.errors()[0]
            where = "".join(f"{part}: " for part in first["loc"])
            raise UsageError(f"--tacho {text}: {where}{first['msg'].removeprefix('Value error, ')}") from error
    found = tuple(tachos) or INSTANTANEOUS
    try:
        tacho_of_each_fan(found, fans)
    except ValueError as error:
        raise UsageError(f"--tacho: {error}") from error
    return found
