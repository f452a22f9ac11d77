"""Which trays a process of a stage has, what it is called, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import (
    MOST_NAME_CHARACTERS,
    Shard,
    chosen_shard,
    chosen_trays,
    own_file,
    process_list,
    shards_of,
)
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.sessions import Session

NAMES = ("a", "b", "c", "d", "e")
WHOLE = Shard("all", NAMES)


def site(*overrides: str, names: tuple[str, ...] = NAMES) -> Config:
    trays = "".join(f'[[tray]]\nname = "{name}"\nfans = 2\ntwin = "x.onnx"\n' for name in names)
    return parse_config(trays, Path("site.toml"), overrides, stages=())


@pytest.mark.parametrize("number", range(1, len(NAMES) + 1))
def test_the_shards_of_a_stage_have_every_tray_once_and_differ_by_one_at_most(number):
    shards = shards_of("scorer", site(f"launcher.shards={number}"))
    assert sorted(tray for shard in shards for tray in shard.trays) == list(NAMES)
    sizes = [len(shard.trays) for shard in shards]
    assert len(sizes) == number
    assert max(sizes) - min(sizes) <= 1


def test_a_tray_called_all_is_one_tray():
    first, second = shards_of("acquisition", site(names=("all", "b")))
    sessions = [Session.of_this_process("acquisition", shard, 1, "p") for shard in (first, second)]
    assert [session.trays for session in sessions] == [("all",), ("b",)]
    assert not sessions[0].shares_a_tray_with(sessions[1])


def test_what_the_launcher_starts_is_what_the_options_of_run_choose():
    config = site("launcher.shards={ scorer = 2, resampler = 5 }")
    for row in process_list(config):
        options = dict(zip(row.shard.words[::2], row.shard.words[1::2], strict=True))
        chosen = chosen_shard(row.stage, config, options.get("--trays"), options.get("--shard"))
        assert chosen == row.shard


def test_one_number_for_all_leaves_the_viewer_alone_and_a_table_may_name_it():
    def count(stage: str, override: str) -> int:
        return len(shards_of(stage, site(override)))

    assert [count(stage, "launcher.shards=2") for stage in ("acquisition", "scorer", "viewer")] == [2, 2, 1]
    assert [count(stage, "launcher.shards={viewer=2}") for stage in ("acquisition", "scorer", "viewer")] == [5, 1, 2]


def test_the_trays_that_are_named_name_the_process_in_the_order_of_the_configuration():
    config = site()
    assert chosen_shard("scorer", config, "d,b,d") == Shard("b+d", ("b", "d"), ("--trays", "b,d"))
    assert chosen_shard("scorer", config, "c") == Shard("c", ("c",), ("--trays", "c"))
    assert chosen_shard("scorer", config, "e,d,c,b,a") == chosen_shard("scorer", config, shard="1/1") == WHOLE


def test_the_name_of_a_process_with_many_trays_fits_a_file_name_and_is_its_own():
    names = tuple(f"{'long' * 14}-{number}" for number in range(9))
    one, other = (chosen_shard("scorer", site(names=names), ",".join(chosen)) for chosen in (names[:5], names[:6]))
    assert one.name != other.name
    assert len(own_file(one.name, Path("recording.mcap")).name) < 100


def test_hosts_that_share_the_trays_start_every_process_once():
    config = site("launcher.shards={ scorer = 4, recorder = 2 }")
    hosts = [process_list(config, chosen_trays(config, None, f"{host}/2")) for host in (1, 2)]
    started = [row.label for rows in hosts for row in rows]
    assert sorted(started) == sorted(row.label for row in process_list(config))
    assert [row.label for row in hosts[1]] == [
        *("acquisition/b", "acquisition/d", "scorer/2-of-4", "scorer/4-of-4", "recorder/2-of-2")
    ]


def test_a_shard_whose_names_do_not_fit_a_token_is_refused():
    names = tuple(f"{'x' * 100}{number:04}" for number in range(MOST_NAME_CHARACTERS // 100 + 2))
    with pytest.raises(UserError, match="and 32,768 are possible: make more shards"):
        chosen_shard("scorer", site(names=names), ",".join(names[1:]))
    assert chosen_shard("scorer", site(names=names)).is_whole, "all trays need no names"


def test_a_tray_that_is_added_at_the_end_moves_no_other_one():
    before, after = (shards_of("scorer", site("launcher.shards=3", names=names)) for names in (NAMES, (*NAMES, "f")))
    assert [set(old.trays) <= set(new.trays) for old, new in zip(before, after, strict=True)] == [True] * 3


def test_the_files_of_a_shard_are_taken_for_no_part_of_another_recording():
    assert own_file("all", Path("recording.mcap")) == Path("recording.mcap")
    assert own_file("2-of-8", Path("there/recording.mcap")) == Path("there/2-of-8.recording.mcap")
