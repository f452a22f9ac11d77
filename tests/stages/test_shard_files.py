"""The files and ports of stages that run as several processes in one run folder on one host."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pipeline.config.models import TrayConfig
from pipeline.runtime.stage import Context
from schemas.codec import encode
from schemas.envelope import Envelope
from schemas.header import Header
from schemas.messages import ScorerSnapshot
from schemas.topics import tray_key
from stages import recorder, viewer
from stages.recorder import RecorderConfig
from stages.viewer import ViewerConfig

TRAYS = tuple(TrayConfig(name=name, fans=2) for name in ("a", "b", "c"))


def context(folder: Path, number: int, trays: tuple[TrayConfig, ...]) -> Context:
    return Context(
        site="plant",
        trays=trays,
        config=RecorderConfig(min_free_bytes=0),
        folder=folder,
        run_folder=folder,
        started_t_ns=1_800_000_000_000_000_000,
        instance=f"{number}-of-2",
        shard_number=number,
    )


def snapshot(tray: str, sequence: int) -> Envelope:
    message = ScorerSnapshot(
        header=Header("scorer-1", sequence, tray), t_ns=sequence, twin_sha256="x", state_json="{}" * 100
    )
    return Envelope.of(tray_key("plant", tray, "snapshot"), message, 1_800_000_000_000_000_000 + sequence)


def kept_by(context: Context) -> Mapping[str, bytes]:
    """What a recorder that starts keeps for others."""
    built = recorder.build(context)
    built.core.abort()
    return built.kept


def test_a_recorder_that_is_restarted_keeps_the_last_snapshots_of_its_recording_for_others(tmp_path):
    of_shard = context(tmp_path, 1, TRAYS[:2])
    assert kept_by(of_shard) == {}
    for part in range(2):
        built = recorder.build(of_shard)
        built.core.step(snapshot("a", 2 * part))
        built.core.step(snapshot("a", 2 * part + 1))
        if not part:
            built.core.step(snapshot("b", 7))
        built.core.close()
    last = {each.key: encode(each.message) for each in (snapshot("a", 3), snapshot("b", 7))}
    assert kept_by(of_shard) == last
    moved = replace(of_shard, trays=TRAYS[1:])
    assert kept_by(moved) == {snapshot("b", 7).key: last[snapshot("b", 7).key]}, "of its trays only"


def test_the_viewers_of_two_shards_take_two_ports(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        config = ViewerConfig(grpc_port=port, web_port=0)
        first, second = (replace(context(tmp_path, n, TRAYS[:1]), config=config) for n in (1, 2))
        assert f"port {port} on 127.0.0.1 is taken" in viewer.check(first)[0]
        assert not any(f"port {port} " in problem for problem in viewer.check(second))
