"""The card of a twin, read without onnx or onnxruntime. pipeline.prediction.twin_file runs it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.runtime.stage import StageError
from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho, tacho_of_each_fan
from fantwin.schemas.twin_card import CARD_PROPERTY, BalanceCard, CardError, DriveCard, TwinCard
from fantwin.scoring.unseen_error import UnseenError

_FIELD = descriptor_pb2.FieldDescriptorProto


def read_onnx_metadata(content: bytes) -> dict[str, str]:
    """The metadata properties of an ONNX file; all else in it is skipped.

    Raises:
        ValueError: it is not an ONNX file.
    """
    return {entry.key: entry.value for entry in _parsed(content).metadata_props}


def without_metadata(content: bytes) -> bytes:
    """An ONNX file without its metadata properties: equal for files of the same graph and weights.

    Raises:
        ValueError: it is not an ONNX file.
    """
    model = _parsed(content)
    model.ClearField("metadata_props")
    return model.SerializeToString()


def _parsed(content: bytes) -> Any:
    try:
        return _MODEL.FromString(content)
    except DecodeError as error:
        raise ValueError("not an ONNX file") from error


def _model_message() -> Any:
    """The message ModelProto of onnx.proto with the one field needed here. Field numbers are those of onnx.proto."""
    file = descriptor_pb2.FileDescriptorProto(
        name="fantwin_onnx_metadata.proto", package="fantwin_onnx", syntax="proto3"
    )
    entry = file.message_type.add(name="StringStringEntryProto")
    for number, name in enumerate(("key", "value"), start=1):
        entry.field.add(name=name, number=number, type=_FIELD.TYPE_STRING, label=_FIELD.LABEL_OPTIONAL)
    file.message_type.add(name="ModelProto").field.add(
        name="metadata_props",
        number=14,
        type=_FIELD.TYPE_MESSAGE,
        type_name=".fantwin_onnx.StringStringEntryProto",
        label=_FIELD.LABEL_REPEATED,
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("fantwin_onnx.ModelProto"))


_MODEL = _model_message()


LARGEST_TWIN_BYTES = 64 << 20
"""size of a twin's file; the demo's has 28 kB"""
RANGE_MARGIN, RANGE_MARGIN_OF_TABLE = 0.05, 0.25
"""share of the width of the training range by which a twin may leave it; the second if its card has a table of its own
error"""
DEAD_ZONE = 0.25
"""share of the command range; a larger friction is not taken for a dead zone"""


@dataclass(frozen=True)
class Balance:
    """The torque balance of each fan: schemas.twin_card.BalanceCard as arrays.

    filter_rate_per_s: one number. All others: (fans,).
    """

    inertia: Array
    viscous: Array
    drag: Array
    friction: Array
    lag_s: Array
    sigma_command: Array
    lowest_speed_rad_s: Array
    filter_rate_per_s: float

    def of_fans(self, rows: Sequence[int]) -> Balance:
        """Balance of the fans in these rows."""
        arrays = {name: values[rows] for name, values in vars(self).items() if name != "filter_rate_per_s"}
        return Balance(**arrays, filter_rate_per_s=self.filter_rate_per_s)

    @classmethod
    def from_card(cls, card: BalanceCard, fans: int) -> Balance:
        """Balance of a card for a tray of `fans` fans."""
        used = {name for name in cls.__dataclass_fields__ if name != "filter_rate_per_s"}
        arrays = {name: for_fans(values, fans) for name, values in card.per_fan.items() if name in used}
        return cls(**arrays, filter_rate_per_s=card.filter_rate_per_s)


@dataclass(frozen=True)
class TrayTwin:
    """A twin's card, and what it holds for each fan of a tray. A twin of one fan serves every fan.

    card_json: the card as it stands in the file. sha256: of the file. sigma_rad_s: (fans,), standard deviation of the
    healthy residual. tachos: (fans,) how the speed of each is measured. drive: None: the command acts as it is.
    """

    card: TwinCard
    card_json: str
    sha256: str
    sigma_rad_s: Array
    balance: Balance
    tachos: tuple[Tacho, ...]
    drive: DriveCard | None

    @property
    def fans(self) -> int:
        """The number of fans of the tray."""
        return len(self.sigma_rad_s)

    @property
    def off_below(self) -> Array:
        """(fans,) the smallest command that turns the rotor: the friction, or -inf where it is not a dead zone.

        Friction amid the healthy commands is no dead zone: the fan was held at one speed, where a friction and a drag
        cannot be distinguished.
        """
        low, high = self.card.command_range
        friction = self.balance.friction
        return np.where((friction > 0.0) & (friction < low + DEAD_ZONE * (high - low)), friction, -np.inf)

    @property
    def usable_commands(self) -> tuple[float, float]:
        """The lowest and the highest command for which the twin is used."""
        low, high = self.card.command_range
        margin = (RANGE_MARGIN_OF_TABLE if self.unseen_error else RANGE_MARGIN) * (high - low)
        return low - margin, high + margin

    @property
    def unseen_error(self) -> UnseenError | None:
        """Error that the twin may have where it was not trained; None where the card says nothing about it."""
        table = self.card.model_uncertainty
        if table is None or not table.seen_std_rad_s:
            return None
        return UnseenError(table, self.card.drive, self.balance.viscous, self.balance.drag)


def for_fans(values: tuple[Any, ...], fans: int) -> Array:
    """(fans, ...) values of each fan; those of a twin of one fan hold for all."""
    of_card = np.array(values, dtype=np.float64)
    return np.broadcast_to(of_card, (fans, *of_card.shape[1:])).copy()


def read_file(path: Path) -> bytes:
    """The content of a twin's file.

    Raises:
        StageError: it cannot be read, or is too large.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_TWIN_BYTES + 1)
    except OSError as error:
        raise StageError(f"{path}: cannot read the twin: {error.strerror}; correct [[tray]] twin") from error
    if len(content) > LARGEST_TWIN_BYTES:
        raise StageError(f"{path}: larger than {LARGEST_TWIN_BYTES:,} bytes, so not a twin; correct [[tray]] twin")
    return content


def tray_twin(path: Path, content: bytes, fans: int | None) -> TrayTwin:
    """Load the twin in the content of a file for a tray of `fans` fans; without `fans`, for as many as it has.

    Raises:
        StageError: it is not a twin, of another format, or for other fans.
    """
    try:
        card_json = read_onnx_metadata(content).get(CARD_PROPERTY)
    except ValueError as error:
        raise StageError(f"{path}: {error}; make a twin: fantwin train") from error
    if card_json is None:
        raise StageError(f"{path}: not a twin: it has no {CARD_PROPERTY}; make one: fantwin train")
    try:
        card = TwinCard.from_json(card_json)
    except CardError as error:
        raise StageError(f"{path}: {error}") from error
    fans = fans or card.fans
    if card.fans not in (1, fans):
        raise StageError(f"{path}: a twin of {card.fans} fans, [[tray]] says fans = {fans}: choose a twin that fits")
    return TrayTwin(
        card=card,
        card_json=card_json,
        sha256=hashlib.sha256(content).hexdigest(),
        sigma_rad_s=for_fans(card.sigma_rad_s, fans),
        balance=Balance.from_card(card.balance, fans),
        tachos=tacho_of_each_fan(card.tacho, fans),
        drive=card.drive,
    )


def load_tray_twin(path: Path, fans: int | None = None) -> TrayTwin:
    """Load the twin in a file for a tray of `fans` fans; without `fans`, for as many as it has. Its graph is not
    loaded.

    Raises:
        StageError: the file cannot be read, is not a twin, of another format, or for other fans.
    """
    return tray_twin(path, read_file(path), fans)


def twin_path(tray: TrayConfig, folder: Path) -> Path:
    """Path of the twin of a tray. folder: of the configuration.

    Raises:
        StageError: the tray names none.
    """
    if tray.twin is None:
        raise StageError(
            f'tray {tray.name} has no twin: set [[tray]] twin = "FILE.onnx", or leave out launcher.stages to learn one'
        )
    return folder / tray.twin
