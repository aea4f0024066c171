"""Which velod a command looks at, and the way to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from velod.cli.config import settings_of
from velod.config import ZenohSettings
from velod.runtime.session import introducer_endpoint


@dataclass(frozen=True, slots=True)
class Place:
    """Which velod: its rig's name, or ``*`` for all rigs, and how to reach it."""

    rig: str
    zenoh: ZenohSettings

    @property
    def connect(self) -> str:
        """The endpoint, or the file that names it."""
        return self.zenoh.config or self.zenoh.connect


@dataclass(frozen=True, slots=True)
class Way:
    """What the command line says of the way to a velod; what it leaves open the settings file says."""

    connect: str | None = None
    rig: str | None = None
    keys: str | None = None
    role: str | None = None
    insecure: bool = False


def place_of(config: str | None, way: Way, role: str) -> Place:
    """Where to look, as ``role`` unless said otherwise. Raises ConfigError."""
    settings = settings_of(config)
    zenoh = replace(
        settings.zenoh,
        connect=way.connect or introducer_endpoint(settings.zenoh),
        listen="",
        config="" if way.connect else settings.zenoh.config,
        keys=way.keys or settings.zenoh.keys,
        role=way.role or role,
        insecure=way.insecure or settings.zenoh.insecure,
    )
    return Place(way.rig or settings.rig.name, zenoh)
