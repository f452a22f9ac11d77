"""One [[tray]] for many devices alike: `hosts`."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.host_address import hosts_of, ranges_of
from fantwin.pipeline.sources.redfish.config import RedfishConfig

HALL = """
[[tray]]
hosts = ["bmc[098-101].hall", { host = "10.0.0.7", rack = "B7" }, { host = "spare.hall", name = "old", rack = "C1" }]
twin = "twins/{name}.onnx"
source = { kind = "redfish", url = "https://ann@{host}", password_file = "secrets" }
fan = [{ name = "FAN1", place = "PLACE" }]
"""
DRIVE = '[[tray]]\nname = "drive"\nfans = 1\nsource = { kind = "hwmon", chip = "x" }\n'


def site(text: str) -> Config:
    return parse_config(text, Path("site.toml"), stages=())


def test_each_host_is_a_tray_with_its_own_name_address_and_texts() -> None:
    config = site(HALL.replace("PLACE", "row 1"))
    assert [tray.name for tray in config.trays] == ["bmc098", "bmc099", "bmc100", "bmc101", "10-0-0-7", "old"]
    tray = config.trays[3]
    assert isinstance(tray.source, RedfishConfig) and tray.source.url == "https://ann@bmc101.hall"
    assert (tray.twin, tray.fan[0].place) == (Path("twins/bmc101.onnx"), "row 1")
    racks = HALL.replace("PLACE", "rack {rack}").replace('"bmc[098-101].hall", ', "")
    assert [tray.fan[0].place for tray in site(racks).trays] == ["rack B7", "rack C1"]


def test_one_process_asks_all_controllers_and_others_keep_their_own() -> None:
    text = HALL.replace("PLACE", "row 1")
    rows = process_list(site(f"{DRIVE}{text}{DRIVE.replace('drive', 'other')}"))
    acquisition = [row.shard for row in rows[:3]]
    assert [len(shard.trays) for shard in acquisition] == [1, 6, 1]
    assert [shard.is_whole for shard in acquisition] == [False] * 3
    assert process_list(site(text))[0].shard.is_whole
    set_apart = site(f"launcher = {{ shards = {{ acquisition = 3 }} }}\n{text}")
    assert [row.label for row in process_list(set_apart)][:3] == [f"acquisition/{n}-of-3" for n in (1, 2, 3)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("PLACE", "rack {rack}"), "tray: hosts: 'rack {rack}': host bmc098.hall has no rack"),
        (("{host}", "bmc1"), "tray: hosts: several would be one device: write {host} in source"),
        (("098-101", "101-098"), r"tray: bmc\[101-098\].hall: a range from low to high"),
        (("098-101", "1-"), r"tray: bmc\[1-\].hall: no range; write \[001-400\] or \[1-4,7\]"),
        (("098-101", "0-99999"), "of at most 4,096 hosts"),
        (("spare.hall", "bmc100.lab"), "two trays have the same name; names must differ: 'bmc100'"),
        (('host = "10.0.0.7", ', ""), "give a name, a range, or a table of texts with host"),
    ],
)
def test_hosts_that_cannot_be_trays_are_one_line(change: tuple[str, str], said: str) -> None:
    text = HALL.replace(', name = "old"', "").replace(*change).replace("PLACE", "row 1")
    with pytest.raises(UserError, match=said):
        site(text)


@pytest.mark.parametrize(
    ("hosts", "ranges"),
    [
        (["node002", "node001", "node003"], ["node[001-003]"]),
        (["node10", "node9", "node2", "spare"], ["node2", "node[9-10]", "spare"]),
        (["10.0.0.7", "10.0.0.8", "10.0.1.8"], ["10.0.0.[7-8]", "10.0.1.8"]),
        (["r1n1.hall", "r1n2.hall", "r2n1.hall"], ["r1n[1-2].hall", "r2n1.hall"]),
        (["n08", "n9"], ["n08", "n9"]),
    ],
)
def test_hosts_become_the_ranges_that_stand_for_them(hosts: list[str], ranges: list[str]) -> None:
    assert ranges_of(hosts) == ranges
    assert sorted(host for each in ranges for host in hosts_of(each)) == sorted(hosts)
