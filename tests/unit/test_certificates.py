"""Certificates: what `velod config keys` writes, and that what is wrong with one is said before Zenoh is asked."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from velod.cli import main
from velod.config import ZenohSettings
from velod.runtime.access import ROLES, common_name
from velod.runtime.certificates import (
    Authority,
    CertificateError,
    check_keys,
    make_keys,
    new_authority,
    new_certificate,
    write_pair,
)
from velod.runtime.session import SessionError, open_session


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, hosts=["10.0.0.5", "robot.local"], rigs=["drone"])
    return folder


def replaced(folder: Path, authority: Authority, role: str, name: str, days: float = 1.0) -> Path:
    """A folder in which the certificate of ``role`` is another one."""
    write_pair(folder / "ca.pem", folder / "ca.key", authority.certificate, authority.key)
    write_pair(folder / f"{role}.pem", folder / f"{role}.key", *new_certificate(authority, name, days=days))
    return folder


def test_every_role_and_the_server_have_a_certificate_that_is_good(keys: Path) -> None:
    for role in (*ROLES, "server"):
        check_keys(keys, role)
    for role in ROLES:
        check_keys(keys / "drone", role, rig="drone")


def test_private_keys_are_for_their_owner_alone(keys: Path) -> None:
    private = list(keys.rglob("*.key"))
    assert len(private) == 1 + 5 + 4
    assert {stat.S_IMODE(path.stat().st_mode) for path in private} == {0o600}


def test_a_second_call_keeps_the_authority_and_what_it_signed_before(keys: Path, tmp_path: Path) -> None:
    make_keys(tmp_path)
    before = (tmp_path / "ca.pem").read_bytes()
    make_keys(tmp_path, rigs=["late"])
    assert (tmp_path / "ca.pem").read_bytes() == before == (tmp_path / "late" / "ca.pem").read_bytes()
    check_keys(tmp_path / "late", "worker", rig="late")


def test_a_missing_certificate_is_named(tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match=r"ca\.pem: No such file.*velod config keys"):
        check_keys(tmp_path, "worker")


def test_an_expired_certificate_is_named_with_its_date(tmp_path: Path) -> None:
    folder = replaced(tmp_path, new_authority(), "worker", common_name("worker"), days=-1.0)
    with pytest.raises(CertificateError, match=r"worker\.pem: expired on 20\d\d-"):
        check_keys(folder, "worker")


def test_a_certificate_of_another_authority_is_named(keys: Path, tmp_path: Path) -> None:
    folder = replaced(tmp_path, new_authority(), "worker", common_name("worker"))
    (folder / "ca.pem").write_bytes((keys / "ca.pem").read_bytes())
    with pytest.raises(CertificateError, match=r"worker\.pem: was not signed by the CA in .*ca\.pem"):
        check_keys(folder, "worker")


def test_a_certificate_of_another_role_or_rig_is_named(keys: Path, tmp_path: Path) -> None:
    folder = replaced(tmp_path, new_authority(), "worker", common_name("consumer"))
    with pytest.raises(CertificateError, match=r"is of the role consumer .*, not worker"):
        check_keys(folder, "worker")
    with pytest.raises(CertificateError, match="is for rig drone alone, not plane"):
        check_keys(keys / "drone", "worker", rig="plane")


def test_a_key_that_belongs_to_another_certificate_is_named(tmp_path: Path) -> None:
    make_keys(tmp_path)
    (tmp_path / "worker.key").write_bytes((tmp_path / "driver.key").read_bytes())
    with pytest.raises(CertificateError, match=r"worker\.key: is not the key of .*worker\.pem"):
        check_keys(tmp_path, "worker")


@pytest.mark.parametrize("name", ["worker.pem", "worker.key"])
def test_garbage_is_named(name: str, tmp_path: Path) -> None:
    make_keys(tmp_path)
    (tmp_path / name).write_bytes(b"-----BEGIN NOTHING-----\n")
    with pytest.raises(CertificateError, match=f"{name}: not a "):
        check_keys(tmp_path, "worker")


def test_what_is_wrong_is_said_before_a_session_is_opened(tmp_path: Path) -> None:
    settings = ZenohSettings(connect="tls/127.0.0.1:1", keys=str(tmp_path))
    with pytest.raises(CertificateError, match=r"ca\.pem"):
        open_session(settings)
    with pytest.raises(SessionError, match=r"set zenoh\.keys"):
        open_session(ZenohSettings(connect="tls/127.0.0.1:1"))


def test_the_command_says_what_it_wrote_and_what_to_keep_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "keys", str(tmp_path), "--rig", "drone", "--days", "30"]) == 0
    said = capsys.readouterr().out
    assert f"wrote {tmp_path / 'drone' / 'driver.pem'}" in said and "keep it off" in said
