"""``velod config``: settings and calibration files."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from velod import config
from velod.config import ConfigError, Settings

if TYPE_CHECKING:
    from velod.geometry.calibration import Calibration


def settings_of(path: str | None, calibration: str | None = None) -> Settings:
    """The settings of a file, or the defaults; ``calibration`` replaces rig.calibration. Raises ConfigError."""
    settings = Settings() if path is None else config.load(path)
    return settings if calibration is None else replace(settings, rig=replace(settings.rig, calibration=calibration))


def calibration_of(settings: Settings) -> Calibration | None:
    """The calibration that the settings name, if they do. Raises CalibrationError."""
    if not settings.rig.calibration:
        return None
    from velod.geometry.calibration_files import load_calibration

    return load_calibration(settings.rig.calibration)


def show(path: str | None) -> int:
    """Print the settings in effect, as TOML."""
    sys.stdout.write(config.to_toml(settings_of(path), explain=False))
    return 0


def init(path: str, *, force: bool) -> int:
    """Write all settings with their meaning; refuses to overwrite a file unless ``force``."""
    text = config.to_toml(Settings())
    try:
        with Path(path).open("w" if force else "x", encoding="utf-8") as f:
            f.write(text)
    except FileExistsError:
        raise ConfigError(f"{path}: exists already; --force overwrites it") from None
    print(f"wrote {path}")
    return 0


def check(path: str) -> int:
    """Say whether velod would take a settings file, and the calibration that it names."""
    from velod.runtime.endpoints import parse, refuse_missing_keys

    settings = config.load(path)
    for name, endpoint in (("connect", settings.zenoh.connect), ("listen", settings.zenoh.listen)):
        if endpoint:
            parse(endpoint, f"{path}: zenoh.{name}")
    refuse_missing_keys(settings.zenoh.keys)
    named = calibration_of(settings) is not None
    print(f"{path}: good" + ("" if named else "; rig.calibration is empty, and `velod run` needs one"))
    return 0


def calibration(path: str, imu_path: str | None) -> int:
    """Read a calibration of any known kind and print it as velod's own YAML."""
    import yaml

    from velod.geometry.calibration_files import load_calibration

    yaml.safe_dump(load_calibration(path, imu_path).to_tree(), sys.stdout, sort_keys=False)
    return 0
