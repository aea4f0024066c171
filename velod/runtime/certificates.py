"""Certificates: a CA and one certificate per role, made with ``cryptography``; and what is wrong with given ones.

Zenoh says only "Timeout" where a certificate is not accepted, so the files are looked at before a session is opened.
The package cryptography is an extra, velod[keys]: import this module only where certificates are asked for.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from velod.runtime.access import ROLES, SERVER, common_name
from velod.runtime.endpoints import SessionError
from velod.runtime.key_paths import KeyPaths

CA_NAME = "velod-ca"
_CLOCK_SKEW = dt.timedelta(hours=1)
_CA_DAYS = 3650


class CertificateError(SessionError):
    """A certificate that cannot be used, or is missing; the text names the file and the reason."""


@dataclass(frozen=True, slots=True)
class Authority:
    """A CA that signs: its certificate and key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_keys(
    folder: str | Path, hosts: Sequence[str] = (), rigs: Sequence[str] = (), days: float = 365.0
) -> list[Path]:
    """Write a CA (unless the folder has one), a server's certificate for ``hosts``, and one per role.

    For each of ``rigs`` a folder of its own is added, whose certificates are good for that rig alone. ``hosts``:
    names and addresses under which the server is reached, besides localhost. Private keys are readable by the owner
    alone. Returns the files written. Raises CertificateError.
    """
    files = KeyPaths(Path(folder))
    files.folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    if not files.ca.exists():
        authority = new_authority()
        written += write_pair(files.ca, files.ca_key, authority.certificate, authority.key)
    else:
        authority = read_authority(files.folder)
    wanted = [(files, SERVER, "")]
    wanted += [(files, role, "") for role in ROLES]
    wanted += [(KeyPaths(files.folder / rig), role, rig) for rig in rigs for role in ROLES]
    for place, role, rig in wanted:
        place.folder.mkdir(exist_ok=True)
        if place.folder != files.folder:
            place.ca.write_bytes(files.ca.read_bytes())
        names = ("localhost", "127.0.0.1", "::1", *hosts) if role == SERVER else ()
        certificate, key = new_certificate(authority, common_name(role, rig), names, days)
        written += write_pair(place.certificate(role), place.key(role), certificate, key)
    return written


def new_authority() -> Authority:
    """A CA of its own."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(CA_NAME)
    builder = _builder(name, name, key, _CA_DAYS).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True
    )
    usage = x509.KeyUsage(
        digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    builder = builder.add_extension(usage, critical=True)
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    return Authority(builder.sign(key, hashes.SHA256()), key)


def read_authority(folder: str | Path) -> Authority:
    """The CA in a folder, with its key. Raises CertificateError."""
    files = KeyPaths(Path(folder))
    certificate = _read(files.ca)
    _check_dates(certificate, files.ca)
    _check_key(files.ca_key, certificate, files.ca)
    key = serialization.load_pem_private_key(files.ca_key.read_bytes(), None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CertificateError(f"{files.ca_key}: not an elliptic-curve key, which velod's own CA has")
    return Authority(certificate, key)


def new_certificate(
    authority: Authority, name: str, hosts: Sequence[str] = (), days: float = 365.0
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """A certificate with the common name ``name``, valid for ``days`` from now on (negative: expired already)."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(_name(name), authority.certificate.subject, key, days)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if name == common_name(SERVER):
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
    builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False
    )
    if hosts:
        alternatives = x509.SubjectAlternativeName([_host(h) for h in dict.fromkeys(hosts)])
        builder = builder.add_extension(alternatives, critical=False)
    return builder.sign(authority.key, hashes.SHA256()), key


def write_pair(
    certificate_path: Path, key_path: Path, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> list[Path]:
    """Write both as PEM, the key readable by its owner alone. Returns the paths."""
    certificate_path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    key_path.unlink(missing_ok=True)
    with os.fdopen(os.open(key_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(pem)
    return [certificate_path, key_path]


def check_keys(folder: str | Path, role: str, rig: str = "") -> KeyPaths:
    """The files of a role (or ``server``) in a folder, once nothing is wrong with them.

    ``rig``: which one a certificate for one rig alone has to be for; empty: any. Raises CertificateError: missing,
    unreadable, expired or not valid yet, signed by another CA, of another role or rig, key of another certificate.
    """
    files = KeyPaths(Path(folder))
    ca, certificate = _read(files.ca), _read(files.certificate(role))
    path = files.certificate(role)
    for whose, at in ((ca, files.ca), (certificate, path)):
        _check_dates(whose, at)
    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        raise CertificateError(f"{path}: was not signed by the CA in {files.ca}") from None
    found = _common_name(certificate)
    has_role, _, has_rig = found.removeprefix("velod-").partition("@")
    if has_role != role:
        raise CertificateError(f"{path}: is of the role {has_role or 'none'} ({found}), not {role}")
    if rig and has_rig not in ("", rig):
        raise CertificateError(f"{path}: is for rig {has_rig} alone, not {rig}")
    _check_key(files.key(role), certificate, path)
    return files


def days_left(files: KeyPaths, name: str) -> float:
    """How long a certificate and the CA that signed it are still valid. Raises CertificateError."""
    ends = min(_read(path).not_valid_after_utc for path in (files.certificate(name), files.ca))
    return (ends - dt.datetime.now(dt.UTC)) / dt.timedelta(days=1)


def _check_dates(certificate: x509.Certificate, path: Path) -> None:
    now = dt.datetime.now(dt.UTC)
    if now > certificate.not_valid_after_utc:
        expired = f"{certificate.not_valid_after_utc:%Y-%m-%d %H:%M}"
        raise CertificateError(f"{path}: expired on {expired} UTC; `velod config keys` makes new ones")
    if now < certificate.not_valid_before_utc:
        raise CertificateError(
            f"{path}: is not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC; is this clock right?"
        )


def _check_key(path: Path, certificate: x509.Certificate, certificate_path: Path) -> None:
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as e:
        raise CertificateError(f"{path}: {e.strerror} (the private key of {certificate_path.name})") from None
    except (ValueError, TypeError):
        raise CertificateError(f"{path}: not a private key (PEM, without a passphrase)") from None
    if key.public_key() != certificate.public_key():
        raise CertificateError(f"{path}: is not the key of {certificate_path}")


def _read(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as e:
        raise CertificateError(f"{path}: {e.strerror}; `velod config keys` makes certificates") from None
    except ValueError:
        raise CertificateError(f"{path}: not a certificate (PEM)") from None


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: float
) -> x509.CertificateBuilder:
    now = dt.datetime.now(dt.UTC)
    until = now + dt.timedelta(days=days)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    # An hour of grace, for hosts whose clocks are behind.
    return builder.not_valid_before(min(now, until) - _CLOCK_SKEW).not_valid_after(until)
