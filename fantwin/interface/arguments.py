"""Checks of the arguments of functions, in one line."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from fantwin.pipeline.errors import FantwinError

HIGHEST_RATE = 8640
"""false alarms of a fan a day: one each ten seconds"""
Rate = Annotated[float, Field(gt=0, le=HIGHEST_RATE, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0)]


def check(name: str, value: Any, kind: Any) -> None:
    """Check an argument by its type, such as `Rate` or `Count | None`; numbers of NumPy will do.

    Raises:
        FantwinError: it has another, or is out of range.
    """
    try:
        TypeAdapter(kind).validate_python(value.item() if hasattr(value, "item") else value, strict=True)
    except (ValidationError, ValueError) as error:
        what = error.errors()[0]["msg"] if isinstance(error, ValidationError) else "it must be one value"
        raise FantwinError(f"{name} = {value!r} cannot be used: {what[0].lower()}{what[1:]}") from None
