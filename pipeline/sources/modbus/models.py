"""Registers of common EC fans and air handling units, as their makers' public documents give them.

A row fills what a [[tray.source.fan]] with its `model` does not name itself. No row says where commands are written:
who connects the fan decides that (`write`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Model:
    """Registers of a model, as the keys of a [[tray.source.fan]].

    source: the document. command: what the command is, and its unit.
    """

    registers: Mapping[str, Mapping[str, Any]]
    command: str
    source: str


_ECBLUE = (
    "Systemair, Corrigo E ventilation, variables for EXOline and Modbus 3.6, chapter 7; addresses as in Ziehl-Abegg"
)
_SAVE = "Systemair, SAVE Modbus variable list, revision 36, 2.3 airflow control"


def input_register(address: int, **more: Any) -> dict[str, Any]:
    """One that is read by function 4."""
    return {"address": address, "table": "input", **more}


MODELS: Mapping[str, Model] = {
    "ebm-papst": Model(
        {
            "speed": input_register(0xD010, scale=1 / 64000, times=0xD119),
            "command": input_register(0xD019, scale=100 / 65536),
        },
        "modulation level of the motor, %, in each mode of operation",
        "ebm-papst Mulfingen, MODBUS parameter specification ACE V1.00, 2.25 and 3.8; Lite V5.01, 3.1 and 3.17",
    ),
    "ziehl-abegg-ecblue": Model(
        {"speed": input_register(14), "command": {"address": 2}, "current": input_register(15, scale=0.01)},
        "speed reference by the bus: rpm in control mode 1 (absolute speed, holding register 4), else %; not that of "
        "an analog input",
        f"{_ECBLUE} L-BAL-E076, 3.3, and L-BAL-E273, 6.7.3",
    ),
    "systemair-save-supply": Model(
        {"speed": input_register(12400), "command": input_register(14000)}, "output to the supply air fan, %", _SAVE
    ),
    "systemair-save-extract": Model(
        {"speed": input_register(12401), "command": input_register(14001)}, "output to the extract air fan, %", _SAVE
    ),
}
