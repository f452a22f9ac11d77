"""Names and places of fans in the configuration: both forms, and one clear line for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import ConfigError, ConfigUsageError, FanConfig, TrayConfig

PATH = Path("site.toml")


def tray(body: str) -> TrayConfig:
    return parse_config(f'[[tray]]\nname = "a"\n{body}', PATH, stages=()).trays[0]


def test_a_list_of_names_is_the_short_form_of_an_entry_for_each_fan() -> None:
    entries = '[[tray.fan]]\nname = "CPU"\nplace = "rack 3, slot 4"\n[[tray.fan]]\n'
    named, listed, counted = tray(entries), tray('fans = ["CPU", "rear top"]'), tray("fans = 2")
    assert named.fan == (FanConfig(name="CPU", place="rack 3, slot 4"), FanConfig())
    assert listed.fan == (FanConfig(name="CPU"), FanConfig(name="rear top"))
    assert counted.fan == (FanConfig(), FanConfig())
    assert [each.fans for each in (named, listed, counted)] == [2, 2, 2]
    assert [named.label(fan) for fan in range(2)] == ["CPU (fan 0)", "fan 1"]


@pytest.mark.parametrize("text", ["0", "CPU", "cpu", " CPU (fan 0) "])
def test_a_fan_is_found_by_its_number_its_name_and_its_label(text: str) -> None:
    assert tray('fans = ["CPU", "rear top"]').fan_called(text) == 0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("CPU1", "tray a: no fan called 'CPU1'; there are CPU (fan 0), rear top (fan 1)"),
        ("2", "fan 2: tray a has fans 0 to 1"),
        ("-1", "fan -1: tray a has fans 0 to 1"),
    ],
)
def test_a_fan_that_is_not_there_is_refused_with_those_that_are(text: str, problem: str) -> None:
    with pytest.raises(ConfigUsageError) as refused:
        tray('fans = ["CPU", "rear top"]').fan_called(text)
    assert str(refused.value) == problem


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("fans = 3\n[[tray.fan]]", "tray.0: fans = 3, and there are 1 [[tray.fan]]: name each fan, or none"),
        ('fans = ["CPU", "cpu"]', "tray.0: two fans are called 'CPU': names of a tray's fans differ"),
        (
            'fans = ["CPU"]\n[[tray.fan]]',
            "tray.0: fans is a list of names, and there are [[tray.fan]]: give one of the two",
        ),
        ('fans = 1\n[tray.fan]\nname = "CPU"', "tray.0: [tray.fan]: write [[tray.fan]], one for each fan"),
        (
            'fans = ["CPU", ""]',
            "tray.0.fan.1.name = '': an empty name: give one, or write [[tray.fan]] for each fan and leave out name",
        ),
        (
            'fans = ["CPU\\nGPU"]',
            "tray.0.fan.0.name = 'CPU\\nGPU': write at most 60 visible characters, without spaces at the ends",
        ),
        (
            f'[[tray.fan]]\nplace = "{61 * "x"}"',
            f"tray.0.fan.0.place = '{61 * 'x'}': write at most 60 visible characters, without spaces at the ends",
        ),
        (
            'fans = ["7"]',
            "tray.0.fan.0.name = '7': a number, or `all`, is no name: it would be taken for other fans",
        ),
        ('[[tray.fan]]\nnane = "CPU"', "unknown key 'tray.0.fan.0.nane'; did you mean 'name'?"),
        ("fans = 1\nfan = 3", "tray.0.fan = 3: input should be a valid tuple"),
    ],
)
def test_a_mistake_is_one_line_that_says_what_to_write(body: str, problem: str) -> None:
    with pytest.raises(ConfigError) as refused:
        tray(body)
    assert str(refused.value) == f"{PATH}: {problem}"
