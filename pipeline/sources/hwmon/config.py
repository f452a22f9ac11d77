"""Settings of a hwmon chip: `source = { kind = "hwmon", chip = "nct6798", fans = [1, 2] }`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.hwmon.drive import DRIVE
from fantwin.pipeline.sources.polling import PolledConfig
from fantwin.schemas.tacho import Tacho

ROOT = Path("/sys/class/hwmon")

Number = Annotated[int, Field(ge=0, le=99)]
DriveName = Annotated[str, Field(pattern=f"^{DRIVE}$")]


class HwmonConfig(PolledConfig, frozen=True):
    """Fans of this computer, as Linux shows them. The command is pwm, 0 to 255, or a speed in rpm."""

    kind: Literal["hwmon"] = "hwmon"
    chip: str = Field(
        min_length=1,
        description="`name` of the chip, for example nct6798; where several have the same name, with the end of the "
        "path of its device: emc2305@1-002f. `fantwin init --hwmon` finds them",
    )
    fans: tuple[Number, ...] = Field(
        default=(),
        description="N of fanN_input, in the order of the tray; without it 1, 2, ... up to the number of fans",
    )
    pwms: tuple[Number | DriveName, ...] = Field(
        default=(),
        description="what drives each fan, or one for all: N of pwmN; nct6798/pwm2; fan1_output or fan1_target, a "
        "speed in rpm. Without it, pwmN with the numbers of the fans",
    )
    speed_scales: tuple[Annotated[float, Field(gt=0, le=100)], ...] = Field(
        default=(),
        description="factor for fanN_input of each fan, or one for all: 0.5 for four pulses a revolution where the "
        "chip takes two",
    )
    temperatures: tuple[Number, ...] = Field(
        default=(), description="N of tempN_input, the temperature of the air at each fan, or one for all"
    )
    voltages: tuple[Number, ...] = Field(
        default=(), description="N of inN_input, the supply voltage of each fan, or one for all"
    )
    voltage_scale: float = Field(
        default=1.0, gt=0, le=1000, description="factor for inN_input, for a divider on the board"
    )
    currents: tuple[Number, ...] = Field(default=(), description="N of currN_input of each fan, or one for all")
    writable: bool = Field(
        default=False,
        description="whether commands are written; each makes pwmN_enable manual (1) if it is not; the end restores it",
    )
    root: Path = Field(default=ROOT, description="folder of the chips")

    @property
    def chip_name(self) -> str:
        """The name of the chip, without its device."""
        return self.chip.partition("@")[0]

    @property
    def why_no_commands(self) -> str:
        """Commands are written only if `writable` is set."""
        return "" if self.writable else "its source does not have writable = true"

    @property
    def stated_tachos(self) -> tuple[Tacho, ...]:
        """Tachos as the driver of the chip measures, where that is known."""
        chip = chip_of(self.chip_name)
        return (chip.tacho,) if chip and chip.tacho else ()
