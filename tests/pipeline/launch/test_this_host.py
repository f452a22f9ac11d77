"""What `fantwin up` runs on this host: without what is not installed, and with a page on a port that is free."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fantwin.pipeline import extras
from fantwin.pipeline.config.settings import ConfigError
from fantwin.pipeline.launch.this_host import load_for_any_host, load_for_this_host, page_addresses, with_free_ports
from fantwin.stages.viewer import PAGE_ABOVE_DATA, ViewerConfig

TRAYS = "".join(f'[[tray]]\nname = "{name}"\nfans = 1\nport = "x"\ntwin = "t.onnx"\n' for name in "ab")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "fantwin.toml").write_text(TRAYS)
    return tmp_path / "fantwin.toml"


@pytest.fixture
def two_ports() -> Iterator[tuple[int, socket.socket]]:
    """A port that is taken, with the socket that has it; the next one is kept free."""
    while True:
        with socket.socket() as taken, socket.socket() as following:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            following.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                following.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            yield port, taken
            return


def test_without_rerun_the_viewer_is_left_out_with_one_line_unless_it_is_named(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "viewer" in load_for_this_host(path).config.stages
    monkeypatch.setattr(extras, "is_installed", lambda module: module != "rerun")
    host = load_for_this_host(path, ['launcher.without=["recorder"]'])
    assert host.config.stages == ("acquisition", "resampler", "twin_integrator", "scorer", "gateway")
    (line,) = host.left_out
    assert line.startswith("stage viewer is left out: it needs the extra `view`: ")
    assert load_for_this_host(path, host.overrides).left_out == (), "a stage and a replay of the recording see the same"
    named = load_for_this_host(path, ['launcher.stages=["scorer", "viewer"]'])
    assert (named.config.stages, named.left_out) == (("scorer", "viewer"), ())
    with pytest.raises(ConfigError, match="unknown stage 'viwer'; did you mean 'viewer'"):
        load_for_this_host(path, ['launcher.without=["viwer"]'])


def test_of_a_site_on_another_host_only_a_viewer_that_is_named_is_expected(path: Path) -> None:
    assert "viewer" in load_for_this_host(path).config.stages
    assert "viewer" not in load_for_any_host(path).stages
    assert load_for_any_host(path, ['launcher.stages=["viewer"]']).stages == ("viewer",)


def test_the_page_takes_the_next_free_port_where_none_is_set(
    path: Path, two_ports: tuple[int, socket.socket], default_port: Callable[[int], None]
) -> None:
    port, _ = two_ports
    default_port(port)
    host = with_free_ports(load_for_this_host(path), None)
    assert page_addresses(host.config) == [f"http://127.0.0.1:{port + 1}/"]
    set_by_hand = with_free_ports(load_for_this_host(path, [f"gateway.port={port}"]), None)
    assert page_addresses(set_by_hand.config) == [f"http://127.0.0.1:{port}/"], "it is refused when the stage starts"


def test_all_shards_of_the_page_need_a_free_port_and_those_of_other_hosts_do_not(
    path: Path, two_ports: tuple[int, socket.socket], default_port: Callable[[int], None]
) -> None:
    port, _ = two_ports
    default_port(port - 1)
    shards = load_for_this_host(path, ["launcher.shards={gateway=2}"])
    both = page_addresses(with_free_ports(shards, None).config)
    assert len(both) == 2 and f"http://127.0.0.1:{port}/" not in both
    assert page_addresses(with_free_ports(shards, ["b"]).config, ["b"])[0] != f"http://127.0.0.1:{port}/"
    none = load_for_this_host(path, ['launcher.without=["gateway"]'])
    assert (with_free_ports(none, None), page_addresses(none.config)) == (none, [])


def test_live_viewers_take_the_next_free_ports_where_none_is_set(
    path: Path, two_ports: tuple[int, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, _ = two_ports
    monkeypatch.setattr(ViewerConfig.model_fields["grpc_port"], "default", taken - PAGE_ABOVE_DATA)
    ViewerConfig.model_rebuild(force=True)
    host = load_for_this_host(path)
    assert with_free_ports(host, None).config.sections["viewer"].web_port > taken  # type: ignore[attr-defined]
    by_hand = load_for_this_host(path, [f"viewer.grpc_port={taken}"])
    assert with_free_ports(by_hand, None).overrides == by_hand.overrides, "it is refused when the stage starts"
    monkeypatch.undo()
    ViewerConfig.model_rebuild(force=True)


@pytest.fixture
def default_port(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    from fantwin.pipeline.outputs.web.config import GatewayConfig  # noqa: PLC0415

    def change(port: int) -> None:
        monkeypatch.setattr(GatewayConfig.model_fields["port"], "default", port)
        GatewayConfig.model_rebuild(force=True)

    yield change
    monkeypatch.undo()
    GatewayConfig.model_rebuild(force=True)
