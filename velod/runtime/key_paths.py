"""Where the certificates of a host are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class KeyPaths:
    """Where the certificates of a folder are."""

    folder: Path

    @property
    def ca(self) -> Path:
        """The certificate of the authority that signed all others."""
        return self.folder / "ca.pem"

    @property
    def ca_key(self) -> Path:
        """The authority's own key: needed to make certificates, and nowhere else."""
        return self.folder / "ca.key"

    def certificate(self, name: str) -> Path:
        """Of a role, or of the server."""
        return self.folder / f"{name}.pem"

    def key(self, name: str) -> Path:
        """The private key that goes with ``certificate(name)``."""
        return self.folder / f"{name}.key"
