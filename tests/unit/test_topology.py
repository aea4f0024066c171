"""Topologies as files, and that nothing reaches beyond the host without certificates unless the settings say so."""

from __future__ import annotations

from pathlib import Path

import pytest

from velod.cli import main
from velod.config import ZenohSettings
from velod.runtime import session
from velod.runtime.endpoints import is_loopback, refuse_what_is_open
from velod.runtime.router import router_config
from velod.runtime.session import SessionError, load_config, open_session
from velod.runtime.topology import TOPOLOGIES, Site, write

SHIPPED = Path(__file__).parents[2] / "deploy" / "zenoh"


@pytest.mark.parametrize("name", sorted(TOPOLOGIES))
def test_the_shipped_files_are_what_the_command_writes(name: str, tmp_path: Path) -> None:
    assert main(["config", "topology", name, "-o", str(tmp_path)]) == 0
    for path in tmp_path.iterdir():
        shipped = (SHIPPED / path.name).read_text("utf-8")
        assert shipped == path.read_text("utf-8"), f"velod config topology {name} -o deploy/zenoh"


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.json5")), ids=lambda path: path.stem)
def test_no_shipped_file_is_open(path: Path) -> None:
    refuse_what_is_open(load_config(str(path)), path.name)


def test_a_site_differs_by_host_rigs_and_rate(tmp_path: Path) -> None:
    write("remote", Site("10.0.0.5", "/k", ("a", "b"), max_hz=10.0), tmp_path)
    assert "tls/10.0.0.5:17448" in (tmp_path / "consumer.json5").read_text("utf-8")
    router = (tmp_path / "remote-router.json5").read_text("utf-8")
    assert all(text in router for text in ("velod-consumer@b", "velod/a/velocity", '"freq": 10.0', "/k/server.key"))
    assert "worker" not in router and "sensor" not in router.split("low_pass_filter")[0]


@pytest.mark.parametrize(
    "settings",
    [
        ZenohSettings(listen="tcp/0.0.0.0:17447"),
        ZenohSettings(listen="tcp/[::]:17447"),
        ZenohSettings(listen="tcp/192.168.1.5:17447"),
        ZenohSettings(connect="tcp/192.168.1.5:17447"),
        ZenohSettings(connect="tcp/robot:17447"),
    ],
    ids=lambda settings: settings.listen or settings.connect,
)
def test_what_would_be_open_to_others_is_refused(settings: ZenohSettings) -> None:
    with pytest.raises(SessionError, match=r"beyond this host without certificates.*velod config keys.*insecure"):
        open_session(settings, introducer=True)
    with pytest.raises(SessionError, match="beyond this host without certificates"):
        router_config(settings)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{mode: "peer"}', r"listen tcp/\[::\]:0 reaches beyond"),
        ('{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:0"]}}', "multicast must be disabled"),
        ('{mode: "client", connect: {endpoints: ["tcp/10.0.0.5:1"]}}', "connect tcp/10.0.0.5:1 reaches beyond"),
        ('{mode: "client", connect: {endpoints: ["udp/10.0.0.5:1"]}}', "connect udp/10.0.0.5:1 reaches beyond"),
        ('{mode: "client", connect: {endpoints: ["tls/10.0.0.5:1"]}}', "enable_mtls must be true"),
        (
            '{mode: "router", listen: {endpoints: ["tls/0.0.0.0:1"]}, transport: {link: {tls: {enable_mtls: true}}}}',
            "access_control must be enabled and deny",
        ),
    ],
)
def test_a_configuration_file_that_is_open_is_refused(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "open.json5"
    path.write_text(text)
    with pytest.raises(SessionError, match=reason):
        open_session(ZenohSettings(config=str(path)))


def test_the_setting_opens_the_door(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zenoh.open", lambda config: config)
    monkeypatch.setattr(session, "keep_from_blocking", lambda opened: None)
    monkeypatch.setattr(session, "tell_of_links", lambda opened: None)
    config = open_session(ZenohSettings(listen="tcp/0.0.0.0:17447", insecure=True), introducer=True)
    assert "tcp/0.0.0.0:17447" in config.get_json("listen/endpoints")


def test_loopback_is_what_no_other_host_reaches() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.9.9.9", "localhost", "::1", "[::1]")))
    assert not any(map(is_loopback, ("0.0.0.0", "[::]", "192.168.1.5", "robot", "localhost.evil.example")))
