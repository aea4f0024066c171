"""Why a TLS connection does not come about: Zenoh says "Timeout", the handshake says more."""

from __future__ import annotations

import socket
import ssl

from velod.runtime.endpoints import Endpoint
from velod.runtime.key_paths import KeyPaths

_CONNECT_S = 2.0
_ALERT_S = 0.5
"""A server that refuses the client's certificate says so after the handshake, within a round trip."""

_ALERTS = {
    "CERTIFICATE_REQUIRED": "it demands a certificate, and got none",
    "UNKNOWN_CA": "the certificate is of a CA that it does not know",
    "CERTIFICATE_EXPIRED": "the certificate has expired, by its clock",
    "BAD_CERTIFICATE": "the certificate is not accepted",
    "CERTIFICATE_REVOKED": "the certificate was revoked",
    "DECRYPT_ERROR": "the certificate was signed by another CA",
    "ACCESS_DENIED": "the certificate gives no access",
}


def tls_verdict(endpoint: Endpoint, files: KeyPaths, role: str) -> str:
    """What the server at ``endpoint`` says to the certificate of ``role``; empty where it has no objection.

    Takes up to 2.5 s. Opens a connection and closes it; sends nothing but the handshake.
    """
    context = ssl.create_default_context(cafile=str(files.ca))
    context.load_cert_chain(files.certificate(role), files.key(role))
    host = endpoint.host.strip("[]")
    try:
        with socket.create_connection((host, endpoint.port), _CONNECT_S) as raw:
            raw.settimeout(_ALERT_S)
            with context.wrap_socket(raw, server_hostname=host) as link:
                link.recv(1)
    except ssl.SSLCertVerificationError as e:
        return f"the server's certificate is not to be trusted: {e.verify_message}"
    except ssl.SSLError as e:
        reason = e.reason or str(e)
        said = next((text for alert, text in _ALERTS.items() if alert in reason), reason)
        return f"the server refuses {files.certificate(role)}: {said}"
    except TimeoutError as e:
        # Silence after the handshake is consent: the server waits for Zenoh's first word.
        return "" if "read" in str(e) or "recv" in str(e) else f"no answer in {_CONNECT_S:g} s"
    except OSError as e:
        return e.strerror or str(e)
    return ""
