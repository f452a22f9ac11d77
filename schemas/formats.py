"""The format numbers of the files that outlive a version of fantwin (docs/reference/versions.md).

Each kind of file has one number. It grows with a change that an earlier reader would misunderstand.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """The format of a kind of file.

    Attributes:
        kind: what the file is, for people.
        written: the number in files that this version writes.
        read: the numbers that this version reads.
        advice: what to do about a file of a number before these, or without one.
    """

    kind: str
    written: int
    read: tuple[int, ...]
    advice: str

    def refusal(self, found: object) -> str:
        """Why a file with this number, or None without one, cannot be read and what to do; empty if it can be."""
        if type(found) is int and found in self.read:  # True is no number
            return ""
        number = f"{self.kind} of format {found!r}" if found is not None else f"{self.kind} without a format number"
        is_newer = type(found) is int and found > max(self.read)
        known = ", ".join(map(str, self.read))
        return f"{number}; this fantwin reads format {known}: {'update fantwin' if is_newer else self.advice}"


RECORDING = Format("a recording", 3, (3,), "read it with the version of fantwin that wrote it, or record again")
TWIN_CARD = Format("a twin card", 1, (1,), "train the twin again")
SNAPSHOT = Format(
    "a scorer's snapshot", 6, (6,), "remove it to start without one; what was learned of the fans is then learned again"
)
CONFIGURATION = Format("a configuration", 1, (1,), "write format = 1, or leave it out")
