"""What ``velod doctor`` looks at: each check looks at one thing and says what it found, and what to do about it."""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import re
import socket
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from velod.config import DepthSettings, ZenohSettings
from velod.events.sensor_size import max_disparity_px
from velod.geometry.calibration import Calibration, CalibrationError, Camera
from velod.geometry.calibration_files import load_calibration
from velod.runtime.access import ROLES, SERVER
from velod.runtime.endpoints import SessionError
from velod.runtime.kernel_cache import cache_directory, ensure_cache_directory, kept_kernels, package_directory
from velod.runtime.session import open_session
from velod.runtime.settings_service import fetch

State = Literal["OK", "WARN", "FAIL"]

MIN_PYTHON = (3, 11)
MIN_SHARED_MIB = 384
"""A pool of 64 MiB for each of the six processes of a service."""
MIN_FREE_MIB = 2048
MIN_CORES = 2
BASELINES_M = (0.01, 1.0)
MAX_OFF_CENTRE = 0.2
"""Of the image's size: principal points of real lenses lie within a few per cent."""
_MIB = 1 << 20
_UNSYNCHRONISED = 5
"""What adjtimex(2) returns while nothing keeps the clock: TIME_ERROR."""
_FOR_DEVELOPERS = ("test", "check", "fuzz")
_IMPORT_NAMES = {"eclipse-zenoh": "zenoh", "opencv-python-headless": "cv2", "PyYAML": "yaml"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    name: str
    state: State
    found: str
    advice: str = ""  # what to do about it


# --- the installation ---


def python() -> Finding:
    """The interpreter."""
    found = ".".join(map(str, sys.version_info[:3]))
    wanted = ".".join(map(str, MIN_PYTHON))
    good = sys.version_info >= MIN_PYTHON
    return Finding("python", "OK" if good else "FAIL", found, "" if good else f"install Python {wanted} or later")


def packages() -> list[Finding]:
    """What velod depends on, each loaded once; and the extras that are there."""
    broken, versions, extras = [], [], set()
    for requirement in metadata.requires("velod") or []:
        name = re.split(r"[^A-Za-z0-9_.-]", requirement)[0]
        if extra := re.search(r"extra == ['\"](\w+)['\"]", requirement):
            if extra[1] not in _FOR_DEVELOPERS:
                extras.add((extra[1], _is_installed(name)))
            continue
        try:
            importlib.import_module(_IMPORT_NAMES.get(name, name))
            versions.append(f"{name} {metadata.version(name)}")
        except (ImportError, OSError) as e:
            broken.append(f"{name}: {e}")
    missing = sorted({extra for extra, there in extras if not there})
    present = sorted({extra for extra, _ in extras} - set(missing))
    advice = "install velod again: pip install -c constraints.txt ." if broken else ""
    return [
        Finding("packages", "FAIL" if broken else "OK", "; ".join(broken) or ", ".join(versions), advice),
        Finding("extras", "OK", f"there: {', '.join(present) or 'none'}; not there: {', '.join(missing) or 'none'}"),
    ]


def _is_installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def kernels() -> Finding:
    """Whether numba can keep what it compiles, and has."""
    ensure_cache_directory()
    cache = cache_directory()
    if not os.access(cache, os.W_OK):
        return Finding("kernels", "FAIL", f"{cache} cannot be written to", "set NUMBA_CACHE_DIR to a folder that can")
    compiled = {path.name.partition(".")[0]: path.stat().st_mtime for path in kept_kernels()}
    changed = [
        p.stem for p in package_directory().rglob("*.py") if p.stat().st_mtime > compiled.get(p.stem, math.inf)
    ]
    if changed or not compiled:
        what = f"older than their source: {', '.join(sorted(changed))}" if changed else "not compiled yet"
        return Finding("kernels", "WARN", what, "velod warmup, once; otherwise the first run waits for them")
    return Finding("kernels", "OK", f"compiled, in {cache}")


# --- the machine ---


def shared_memory(folder: Path = Path("/dev/shm")) -> Finding:
    """Where large messages pass between processes."""
    name = "shared memory"
    try:
        stat = os.statvfs(folder)
    except OSError as e:
        return Finding(name, "WARN", f"{folder}: {e.strerror}", "mount a tmpfs there, or zenoh.shared_memory = false")
    free_mib = stat.f_bavail * stat.f_frsize // _MIB
    if free_mib < MIN_SHARED_MIB:
        return Finding(
            name, "WARN", f"{free_mib} MiB free in {folder}", f"give it {MIN_SHARED_MIB} MiB (docker: --shm-size)"
        )
    return Finding(name, "OK", f"{free_mib} MiB free in {folder}")


def memory(source: Path = Path("/proc/meminfo")) -> Finding:
    """What is left for the processes."""
    try:
        found = re.search(r"MemAvailable:\s+(\d+) kB", source.read_text())
    except OSError:
        found = None
    if found is None:
        return Finding("memory", "OK", "not known on this system")
    free_mib = int(found[1]) // 1024
    good = free_mib >= MIN_FREE_MIB
    advice = "" if good else f"a service needs about {MIN_FREE_MIB} MiB"
    return Finding("memory", "OK" if good else "WARN", f"{free_mib} MiB available", advice)


def processors() -> Finding:
    """How many there are, how busy they are, and whether they are kept slow."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    governors = {p.read_text().strip() for p in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/*_governor")}
    load = os.getloadavg()[0]
    trouble, advice = [], []
    if cores < MIN_CORES:
        trouble.append(f"{cores} core")
        advice.append(f"give velod {MIN_CORES} cores or more")
    if "powersave" in governors:
        trouble.append("governor powersave")
        advice.append("cpupower frequency-set -g performance")
    if load > cores:
        trouble.append(f"load {load:.1f} on {cores} cores")
        advice.append("other processes keep them busy: latencies will be larger")
    if trouble:
        return Finding("processors", "WARN", ", ".join(trouble), "; ".join(advice))
    return Finding(
        "processors", "OK", f"{cores} cores, load {load:.1f}, governor {', '.join(governors) or 'not visible'}"
    )


def clock() -> Finding:
    """Whether something keeps the host's clock: between hosts, ages need it."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "adjtimex"):
        return Finding("clock", "OK", "not known on this system")
    asked = ctypes.create_string_buffer(512)  # struct timex, larger than on any system; modes = 0: only ask
    if libc.adjtimex(asked) == _UNSYNCHRONISED:
        return Finding(
            "clock", "WARN", "not synchronised", "on several hosts: run chrony or ptp4l; on one host: nothing to do"
        )
    return Finding("clock", "OK", "synchronised")


# --- what the settings name ---


def calibration(path: str, depth: DepthSettings) -> Finding:
    """Whether the calibration can be read, and is like that of a stereo camera."""
    if not path:
        return Finding("calibration", "WARN", "none named", "set rig.calibration, or give --calibration FILE")
    try:
        rig = load_calibration(path)
    except (CalibrationError, OSError) as e:
        return Finding("calibration", "FAIL", str(e), "see `velod config calibration --help`")
    if doubts := _doubts(rig):
        return Finding("calibration", "WARN", f"{path}: {'; '.join(doubts)}", "is it the right file, in metres?")
    left = rig.left
    near_m = left.fx * _baseline_m(rig) / max_disparity_px(depth, left.width)
    return Finding(
        "calibration",
        "OK",
        f"{path}: {left.width} x {left.height}, baseline {1e3 * _baseline_m(rig):.1f} mm,"
        f" depth from {near_m:.2f} m on",
    )


def _baseline_m(rig: Calibration) -> float:
    return math.dist((0.0, 0.0, 0.0), rig.t_RL)


def _doubts(rig: Calibration) -> list[str]:
    low_m, high_m = BASELINES_M
    baseline_m = _baseline_m(rig)
    doubts = [] if low_m <= baseline_m <= high_m else [f"a baseline of {baseline_m:g} m"]
    if (arm_m := math.hypot(*rig.T_cam_imu[:3, 3])) > high_m:
        doubts.append(f"an IMU {arm_m:g} m from the camera")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        doubts += [f"{side}: {doubt}" for doubt in _camera_doubts(camera)]
    return doubts


def _camera_doubts(c: Camera) -> list[str]:
    off = max(abs(c.cx / (c.width - 1) - 0.5), abs(c.cy / (c.height - 1) - 0.5))
    doubts = [f"principal point {100 * off:.0f} % off the centre"] if off > MAX_OFF_CENTRE else []
    if not 0.2 < c.fx / c.width < 5.0:
        doubts.append(f"a focal length of {c.fx:g} px for {c.width} px")
    return doubts


def certificates(keys: str, rig: str) -> list[Finding]:
    """Each role's certificate that is in the folder; none where no folder is named."""
    if not keys:
        return []
    try:
        from velod.runtime.certificates import CertificateError, check_keys, days_left
    except ImportError:
        return [Finding("certificates", "FAIL", "the package cryptography is missing", "pip install 'velod[keys]'")]
    found = []
    for role in (*ROLES, SERVER):
        if not (Path(keys) / f"{role}.pem").exists():
            continue
        name = f"certificate {role}"
        try:
            left = days_left(check_keys(keys, role, rig), role)
        except CertificateError as e:
            found.append(Finding(name, "FAIL", str(e), "velod config keys"))
            continue
        late = left < 30.0
        advice = f"velod config keys {keys}, and hand the new ones out" if late else ""
        found.append(Finding(name, "WARN" if late else "OK", f"good for {left:.0f} days", advice))
    return found or [Finding("certificates", "FAIL", f"none in {keys}", f"velod config keys {keys}")]


# --- the service ---


def service(rig: str, zenoh: ZenohSettings, *, expected: bool) -> Finding:
    """Whether a velod answers; ``expected``: somebody said where. Otherwise the port has to be free for one."""
    if not expected and _is_free(zenoh.port):
        return Finding("service", "OK", f"none is running; port {zenoh.port} is free for one")
    try:
        with open_session(zenoh) as session:
            fetch(session, rig, zenoh.connect)
    except SessionError as e:
        return Finding("service", "FAIL", str(e), "is `velod run` up there, and is the way right?")
    except (OSError, ValueError) as e:
        advice = "is `velod run` up there?" if expected else "another program has the port: set zenoh.port"
        return Finding("service", "FAIL", str(e), advice)
    return Finding("service", "OK", f"rig {rig} answers at {zenoh.connect}")


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
