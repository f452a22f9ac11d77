"""The configuration is checked before anything starts, and says what is wrong in one line."""

from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import load_config, parse_config
from fantwin.pipeline.config.settings import ConfigError
from fantwin.pipeline.sources.serial.config import SerialConfig

GOOD = """
site = "lab"
[[tray]]
name = "a"
fans = 8
port = "/dev/ttyUSB0"
[scorer]
alarm_share = 0.25
"""


def parse(text: str, *overrides: str):
    return parse_config(text, Path("conf/fan.toml"), overrides)


def test_a_good_file_gives_every_enabled_stage_its_section():
    config = parse(GOOD)
    assert config.site == "lab"
    assert config.tray("a").fans == 8
    assert config.sections["scorer"].model_dump()["alarm_share"] == 0.25
    of_all = {"acquisition", "resampler", "twin_integrator", "scorer", "recorder", "viewer", "gateway"}
    assert set(config.sections) == of_all | {"learner"}, "the tray names no twin"
    assert set(parse(GOOD.replace("fans = 8", 'fans = 8\ntwin = "a.onnx"')).sections) == of_all
    assert config.run_folder == Path("conf/runs")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "alarm_shrae = 1\n", ["scorer.alarm_shrae", "did you mean 'alarm_share'"]),
        (GOOD.replace("fans = 8\n", ""), ["'tray.0.fans' is missing"]),
        ("site = 'x'\n", ["'tray' is missing"]),
        (
            "format = 2\nnew_key = 1\n" + GOOD,
            ["a configuration of format 2; this fantwin reads format 1: update"],
        ),
        ("format = '1'\n" + GOOD, ["a configuration of format '1'; ", "write format = 1, or leave it out"]),
        ("site = \n", ["not valid TOML"]),
    ],
)
def test_a_mistake_is_one_line_with_file_key_and_remedy(text, words):
    with pytest.raises(ConfigError) as caught:
        parse(text)
    line = str(caught.value)
    assert line.startswith("conf/fan.toml: ")
    assert "\n" not in line
    for word in words:
        assert word in line


def test_a_tacho_is_one_for_all_fans_of_a_tray_or_one_for_each():
    def windows_s(text: str) -> list[float]:
        return [tacho.window_s for tacho in parse(GOOD.replace("fans = 8", text)).tray("a").tachos]

    count = '{ kind = "count", pulses = 2, window_s = %s }'
    assert windows_s("fans = 8") == [0.0]
    assert windows_s(f"fans = 8\ntacho = {count % 1.0}") == [1.0]
    assert windows_s(f"fans = 2\ntacho = [{count % 1.0}, {count % 0.5}]") == [1.0, 0.5]


def test_launcher_stages_says_which_stages_are_enabled():
    config = parse(GOOD, 'launcher.stages=["recorder", "acquisition"]')
    assert config.stages == ("acquisition", "recorder"), "in the order of the data flow"
    assert set(config.sections) == {"acquisition", "recorder"}


def test_only_the_sections_of_the_stages_asked_for_are_checked():
    wrong = GOOD + "alarm_shrae = 1\n"
    config = parse_config(wrong, Path("conf/fan.toml"), stages=("recorder",))
    assert set(config.sections) == {"recorder"}
    with pytest.raises(ConfigError, match="unknown key 'scorrer'"):
        parse_config(GOOD.replace("[scorer]", "[scorrer]"), Path("conf/fan.toml"), stages=())


def test_all_that_is_wrong_in_a_section_is_one_line():
    target = 'name = "a"\nurl_file = "u"\nquiet_hours = "22-6"\n'
    with pytest.raises(ConfigError) as caught:
        parse(f"{GOOD}[notifier]\npge = 3\n[[notifier.target]]\n{target}")
    assert str(caught.value).partition(".toml: ")[2] == (
        "unknown key 'notifier.pge'; did you mean 'page'?; "
        "notifier.target.0.quiet_hours = '22-6': begin and end, such as \"22:00-06:00\""
    )
    with pytest.raises(ConfigError) as caught:
        parse(GOOD + '[notifier.target]\nname = "a"\nurl_file = "u"\n')
    assert "notifier.target: write [[notifier.target]], with two brackets on each side" in str(caught.value)
    with pytest.raises(ConfigError, match=r"\(and 2 more\)$"):
        parse(GOOD + "[gateway]\n" + "".join(f"x{n} = 1\n" for n in range(7)))


def test_two_trays_of_one_name_are_refused():
    with pytest.raises(ConfigError, match="same name"):
        parse(GOOD + '[[tray]]\nname = "a"\nfans = 1\n')


def test_overrides_set_nested_keys_and_keep_their_types():
    config = parse(GOOD, "scorer.alarm_share=2.5", "tray.0.port=/dev/ttyACM1", "bus.endpoint='tcp/127.0.0.1:1'")
    assert config.sections["scorer"].model_dump()["alarm_share"] == 2.5
    assert config.tray("a").source == SerialConfig(port="/dev/ttyACM1")
    assert config.bus.endpoint == "tcp/127.0.0.1:1"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('site = "Prüfstand"'.encode("latin-1"), r"the configuration is not UTF-8 \(byte 10\)"),
        (b"#" * 2_000_000, "larger than 1,048,576 bytes, so no configuration"),
    ],
)
def test_row_15_a_file_that_cannot_be_a_configuration_is_one_line(tmp_path, content, words):
    path = tmp_path / "fantwin.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"fantwin\.toml: {words}"):
        load_config(path)


@pytest.mark.parametrize(
    ("text", "overrides", "words"),
    [
        (GOOD, ["scorer.alarm_share=" + 5000 * "9"], "longer than 1,000 characters"),
        (GOOD + "false_alarms_per_day = " + 5000 * "9", [], "not valid TOML: Exceeds the limit"),
        (GOOD + "false_alarms_per_day = " + 4000 * "9", [], "scorer.false_alarms_per_day = 9999"),
        (GOOD + "false_alarms_per_day = " + 5000 * "[" + 5000 * "]", [], "nested too deeply"),
        (GOOD, ["scorer.false_alarms_per_day=" + 400 * "[" + 400 * "]"], "scorer.false_alarms_per_day = [[[["),
        (GOOD, [".".join(["scorer", *400 * ["a"]]) + "=1"], "unknown key 'scorer.a'"),
        (GOOD, [400 * "9" + "=1"], "unknown key '9999"),
    ],
)
def test_row_15_values_without_measure_are_one_line(text, overrides, words):
    with pytest.raises(ConfigError) as caught:
        parse(text, *overrides)
    line = str(caught.value)
    assert words in line
    assert "more)" not in line, "what follows from the first problem is none of its own"
    assert "\n" not in line
    assert len(line) < 400


def test_a_password_that_somebody_wrote_into_an_address_is_not_repeated_in_the_error() -> None:
    for url in ("mqtt://u:s3cret@broker", "u:s3cret@broker"):
        with pytest.raises(ConfigError, match=r"mqtt\.url: ") as refused:
            parse_config(GOOD, Path("site.toml"), [f"mqtt.url='{url}'"])
        assert "s3cret" not in str(refused.value)
