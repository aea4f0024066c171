"""Settings: TOML -> frozen, validated dataclasses. What is wrong is refused with file, key and reason."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints


class ConfigError(ValueError):
    """A setting that cannot be used; the text names the file, the key and the reason."""


def _f(
    default: Any,
    doc: str,
    *,
    lo: float | None = None,
    hi: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
    or_0: bool = False,
) -> Any:
    """A setting with its default, its meaning and what is allowed (lo <= value <= hi, value > above; or 0)."""
    allowed = {"lo": lo, "hi": hi, "above": above, "choices": choices, "or_0": or_0}
    return field(default=default, metadata={"doc": doc, **allowed})


@dataclass(frozen=True, slots=True)
class RigSettings:
    """Which rig."""

    name: str = _f("rig0", "name of the rig; the second part of every key, velod/<rig>/...")
    calibration: str = _f("", "calibration file (YAML), relative to the current directory; empty: the recording's")


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """What ingest makes of the sensors' streams: batches, selection, and what it leaves out under load."""

    mode: str = _f(
        "batch",
        "selection: 'batch' by batch, or 'event' by event, each as soon as its neighbourhood is complete",
        choices=("batch", "event"),
    )
    slice_ms: float = _f(1.0, "mode 'event': what was selected goes to flow this often, ms", lo=0.1, hi=100.0)
    rest_ms: float = _f(
        5.0,
        "mode 'event': a cell of the image (about as many as the quota) gives one event at the most in this time, ms",
        lo=0.0,
        hi=1000.0,
    )
    batch: str = _f(
        "first",
        "what closes a batch: 'count', 'time', or 'first' of both",
        choices=("first", "count", "time"),
    )
    count: int = _f(
        0,
        "left events in a batch; 0: by the sensor's size, 45000 (Sec. V-A) for a DAVIS346",
        lo=100,
        hi=10_000_000,
        or_0=True,
    )
    period_ms: float = _f(
        0.0,
        "longest batch, ms of sensor time; 0: by the sensor's size, 20 up to 640x480",
        lo=1.0,
        hi=1000.0,
        or_0=True,
    )
    memory_ms: float = _f(100.0, "how far back neighbours reach, ms; independent of the batch", lo=5.0, hi=1000.0)
    refractory_ms: float = _f(
        10.0,
        "an event this soon after the last one of its pixel and polarity is not the first of its burst, ms; 0: off",
        lo=0.0,
        hi=100.0,
    )
    selection: str = _f(
        "burst",
        "'burst': first events of bursts with full neighbourhoods; 'paper': the culling rules of Sec. V-A",
        choices=("burst", "paper"),
    )
    quota: int = _f(
        0,
        "events selected from a batch at the most; 0: by the sensor's size, 500 for a DAVIS346",
        lo=10,
        hi=20_000,
        or_0=True,
    )
    min_neighbours: int = _f(
        20, "neighbours (of 25, the event included) that a selected event must have", lo=6, hi=25
    )
    border_px: int = _f(5, "events closer than this to the image's edge are not selected", lo=2, hi=100)
    paper_time_share: float = _f(
        0.05,
        "rule 3 of Sec. V-A: |t - mean t of the neighbours| at most this share of the batch's duration",
        above=0.0,
        hi=1.0,
    )
    hot_pixel_hz: float = _f(
        0.0, "drop events of pixels firing faster than this over a second, Hz; 0: off", lo=0.0, hi=1e6
    )
    background_ms: float = _f(
        0.0,
        "drop events without an event in the 8 neighbours within this time, ms; 0: off",
        lo=0.0,
        hi=1000.0,
    )
    max_skew_ms: float = _f(
        200.0,
        "a batch waits this long (sensor time) for the other camera, ms, then closes without it",
        lo=1.0,
        hi=10_000.0,
    )
    budget_ms: float = _f(
        100.0,
        "beside a sensor: while a batch or a packet waits for longer than this, less is taken on, ms; 0: never",
        lo=0.0,
        hi=10_000.0,
    )
    event_budget_ms: float = _f(
        10.0,
        "mode 'event', where budget_ms is not 0: likewise, while a packet or a slice waits for longer, ms",
        lo=1.0,
        hi=10_000.0,
    )
    imu_frozen_samples: int = _f(50, "so many identical IMU samples in a row mean a frozen IMU", lo=3, hi=100_000)


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """The flow workers, and which plane fits give a flow."""

    workers: int = _f(1, "processes", lo=1, hi=64)
    reject_px: float = _f(
        1.0,
        "a neighbour further than this from the plane is dropped and the plane fitted again, px",
        above=0.0,
        hi=10.0,
    )
    rejections: int = _f(2, "rounds of rejection", lo=0, hi=5)
    min_neighbours: int = _f(20, "neighbours left after rejection", lo=6, hi=25)
    max_rms_px: float = _f(0.35, "gate on rms of the fit times speed, px", above=0.0, hi=5.0)
    max_speed_px_s: float = _f(20_000.0, "flows faster than this are refused, px/s", above=0.0, hi=1e6)
    method: str = _f(
        "gradient",
        "'gradient': Eq. 6; 'benosman': per-component reciprocal, the failing baseline of Table II",
        choices=("gradient", "benosman"),
    )


@dataclass(frozen=True, slots=True)
class DepthSettings:
    """The depth workers: matching, refinement and the checks of a match."""

    workers: int = _f(1, "processes", lo=1, hi=64)
    tau_ms: float = _f(10.0, "decay of the time surfaces of block matching, ms", above=0.0, hi=1000.0)
    block_px: int = _f(17, "side of the matching block, odd", lo=5, hi=41)
    max_disparity_px: int = _f(
        0,
        "bounds the nearest depth: f b / max_disparity; 0: by the sensor's width, 48 for a DAVIS346",
        lo=4,
        hi=256,
        or_0=True,
    )
    min_disparity_px: float = _f(0.5, "bounds the farthest depth", above=0.0, hi=32.0)
    min_zncc: float = _f(0.3, "matches below this correlation are refused", lo=-1.0, hi=1.0)
    check: str = _f(
        "left-right",
        "against ambiguous matches: 'left-right', 'uniqueness' or 'none'",
        choices=("left-right", "uniqueness", "none"),
    )
    left_right_px: float = _f(1.0, "left-right disagreement allowed, px", above=0.0, hi=10.0)
    uniqueness: float = _f(0.95, "second peak at most this share of the first", above=0.0, hi=1.0)
    refine: bool = _f(True, "plane-coincidence refinement in the right surface")
    block_only: str = _f(
        "flat",
        "unrefined matches to keep: 'flat': those at near-horizontal edges, which cannot be refined; or 'all'",
        choices=("flat", "all"),
    )
    sigma_zncc_px: float = _f(0.35, "disparity sigma of block matching alone, px", above=0.0, hi=10.0)
    sigma_refined_px: float = _f(
        0.01, "share of a refined match's disparity sigma that no residual shows, px", above=0.0, hi=10.0
    )


@dataclass(frozen=True, slots=True)
class OptimizerSettings:
    """The optimizers: spline, window, weights, output, and from when on the calibration is doubted."""

    workers: int = _f(1, "processes: one leads, the others stand by to take over within 0.1 s", lo=1, hi=8)
    output_hz: float = _f(75.0, "velocities per second of sensor time", lo=1.0, hi=1000.0)
    frame: str = _f(
        "imu", "whose velocity is published: 'imu', 'camera' (the left one), or one of the calibration's frames"
    )
    spline: str = _f(
        "error",
        "what the spline models: 'error' of the IMU-integrated velocity, or the 'velocity' itself (the paper)",
        choices=("error", "velocity"),
    )
    knot_s: float = _f(0.1, "knot interval, s (Sec. V-A)", lo=0.02, hi=1.0)
    window_s: float = _f(1.0, "sliding window, s", lo=0.3, hi=10.0)
    preintegration_s: float = _f(0.03, "IMU preintegration interval, s (Sec. V-A)", lo=0.005, hi=0.5)
    max_wait_ms: float = _f(
        60.0,
        "a velocity waits this long (sensor time) for a missing batch, ms; inf: for ever (lossless replay)",
        lo=1.0,
        hi=math.inf,
    )
    weights: str = _f(
        "propagated",
        "'propagated': each flow's and depth's own sigma; 'fixed': one sigma for all (the paper)",
        choices=("propagated", "fixed"),
    )
    fixed_sigma_px_s: float = _f(20.0, "sigma of a flow residual with weights = 'fixed', px/s", above=0.0, hi=1e4)
    shared_error: float = _f(
        6.0, "information of a batch is divided by this for errors its flows share", lo=1.0, hi=100.0
    )
    shared_gyro_noise: bool = _f(
        True,
        "the gyroscope's noise of a moment is in its flows as well, or false: in the IMU's factor alone (the paper)",
    )
    flow_scale_sigma: float = _f(
        0.002, "1 sigma of an error of all flows' speeds, as a share, which lasts seconds", above=0.0, hi=0.1
    )
    depth_scale_sigma: float = _f(
        0.003, "1 sigma of an error of all inverse depths, as a share, which lasts seconds", above=0.0, hi=0.1
    )
    delay_sigma_ms: float = _f(
        1.0, "1 sigma of how much later than the IMU's the events' stamps are, ms", above=0.0, hi=100.0
    )
    imu_clock_sigma_ms: float = _f(
        20.0,
        "1 sigma of the events' stamps against the IMU's, before anything is known of them, ms",
        above=0.0,
        hi=1e3,
    )
    correct_imu_clock: bool = _f(True, "a delay of the events against the IMU is taken out of their stamps")
    widen_bias_prior: bool = _f(True, "biases that the data make likely widen their prior beyond imu.*_bias_sigma")
    zero_velocity: bool = _f(True, "rest is observed as zero velocity: no moving events and a quiet IMU")
    ransac_iterations: int = _f(64, "minimal samples of the linear solver (Eq. 15)", lo=8, hi=10_000)
    min_flows: int = _f(12, "flows with a depth that a batch must have", lo=6, hi=10_000)
    alarm_clock_ms: float = _f(
        1.0, "alarm where the cameras' clocks are seen to differ by more, ms; 0: never", lo=0.0, hi=100.0
    )
    alarm_rows_px: float = _f(
        0.4, "alarm where the rectified rows are seen to differ by more, px; 0: never", lo=0.0, hi=10.0
    )
    alarm_scale_percent: float = _f(
        0.5, "alarm where the scale is seen to differ from the IMU's by more, %; 0: never", lo=0.0, hi=50.0
    )
    alarm_imu_clock_ms: float = _f(
        1.0, "alarm where events are seen to be later or earlier than the IMU by more, ms; 0: never", lo=0.0, hi=100.0
    )
    alarm_imu_rotation_deg: float = _f(
        1.0,
        "alarm where T_cam_imu's rotation is seen to be off by more about an axis, degrees; 0: never",
        lo=0.0,
        hi=90.0,
    )
    seed: int = _f(1, "of all random choices", lo=0, hi=2**31 - 1)


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """What is known of the IMU: noise densities of continuous time, biases, gravity."""

    accel_noise: float = _f(1.86e-2, "accelerometer white noise density, m/s^2/sqrt(Hz)", above=0.0, hi=10.0)
    gyro_noise: float = _f(1.86e-3, "gyroscope white noise density, rad/s/sqrt(Hz)", above=0.0, hi=1.0)
    accel_bias_walk: float = _f(4.33e-3, "accelerometer bias random walk, m/s^2/sqrt(s)", above=0.0, hi=1.0)
    gyro_bias_walk: float = _f(2.66e-4, "gyroscope bias random walk, rad/s/sqrt(s)", above=0.0, hi=1.0)
    accel_bias_sigma: float = _f(0.05, "accelerometer bias at start, 1 sigma, m/s^2", above=0.0, hi=5.0)
    gyro_bias_sigma: float = _f(0.005, "gyroscope bias at start, 1 sigma, rad/s", above=0.0, hi=1.0)
    gravity: float = _f(9.81, "m/s^2", lo=1.0, hi=20.0)


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """How the processes find each other, and who else may."""

    port: int = _f(17447, "the introducer's port on loopback", lo=1, hi=65535)
    connect: str = _f("", "endpoint of another host's velod, tls/host:port; empty: this host is the introducer")
    listen: str = _f("", "further endpoint on which other hosts may connect, tls/address:port; empty: loopback only")
    keys: str = _f("", "folder with the certificates for tls/ endpoints, as `velod config keys` writes it")
    role: str = _f(
        "worker",
        "as what this host connects with tls/, by the certificate of that name: driver, worker, consumer or operator",
        choices=("driver", "worker", "consumer", "operator"),
    )
    insecure: bool = _f(False, "allow tcp/ endpoints beyond this host, open to everyone who can reach them")
    config: str = _f("", "a zenoh configuration file (JSON5) that replaces all of the above")
    shared_memory: bool = _f(True, "Zenoh's implicit shared memory between processes of one user")
    lossless: bool = _f(False, "replay: block instead of dropping; never beside a sensor")


@dataclass(frozen=True, slots=True)
class Settings:
    """All of them, by section of the TOML file."""

    rig: RigSettings = field(default_factory=RigSettings)
    ingest: IngestSettings = field(default_factory=IngestSettings)
    flow: FlowSettings = field(default_factory=FlowSettings)
    depth: DepthSettings = field(default_factory=DepthSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    zenoh: ZenohSettings = field(default_factory=ZenohSettings)


def load(path: str | Path) -> Settings:
    """Read a TOML file. Raises ConfigError naming file, key and reason."""
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: cannot be read: not text in UTF-8") from None
    return loads(text, str(path))


def loads(text: str, source: str = "<text>") -> Settings:
    """Parse TOML text; ``source`` is named in errors."""
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise ConfigError(f"{source}: not TOML: {e}") from None
    return from_tree(tree, source)


def from_tree(tree: dict[str, Any], source: str = "<settings>") -> Settings:
    """Settings from nested dicts, as TOML or a queryable's answer gives them."""
    sections = get_type_hints(Settings)
    for name in tree:
        if name not in sections:
            raise ConfigError(f"{source}: [{name}]: unknown section; known: {', '.join(sections)}")
    built = {name: _section(cls, tree.get(name, {}), source, name) for name, cls in sections.items()}
    settings = Settings(**built)
    _check_together(settings, source)
    return settings


def _section(cls: type, tree: Any, source: str, section: str) -> Any:
    if not isinstance(tree, dict):
        raise ConfigError(f"{source}: {section}: must be a section, [{section}]")
    hints = get_type_hints(cls)
    for key in tree:
        if key not in hints:
            raise ConfigError(f"{source}: {section}.{key}: unknown key; known: {', '.join(hints)}")
    values = {}
    for f in fields(cls):
        if f.name in tree:
            values[f.name] = _value(tree[f.name], hints[f.name], f.metadata, f"{source}: {section}.{f.name}")
    return cls(**values)


def _value(value: Any, kind: type, meta: Any, where: str) -> Any:
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ConfigError(f"{where}: must be {_KIND[kind]}, got {value!r}")
    if meta["choices"] is not None and value not in meta["choices"]:
        raise ConfigError(f"{where}: must be one of {', '.join(meta['choices'])}, got {value!r}")
    if kind in (int, float) and not (meta["or_0"] and value == 0):
        if value != value:
            raise ConfigError(f"{where}: is NaN")
        if meta["lo"] is not None and value < meta["lo"]:
            raise ConfigError(f"{where}: must be at least {meta['lo']:g}, got {value:g}")
        if meta["hi"] is not None and value > meta["hi"]:
            raise ConfigError(f"{where}: must be at most {meta['hi']:g}, got {value:g}")
        if meta["above"] is not None and value <= meta["above"]:
            raise ConfigError(f"{where}: must be above {meta['above']:g}, got {value:g}")
    return value


_KIND = {str: "a string", int: "an integer", float: "a number", bool: "true or false"}


def _check_together(s: Settings, source: str) -> None:
    """What single values cannot show."""
    if not s.rig.name or any(c in s.rig.name for c in "/*$?# "):
        raise ConfigError(
            f"{source}: rig.name: must be one part of a key, without / * $ ? # or blanks, got {s.rig.name!r}"
        )
    if s.depth.block_px % 2 == 0:
        raise ConfigError(f"{source}: depth.block_px: must be odd, got {s.depth.block_px}")
    if s.optimizer.window_s < 3 * s.optimizer.knot_s:
        raise ConfigError(
            f"{source}: optimizer.window_s: must be at least three knot intervals ({3 * s.optimizer.knot_s:g} s)"
        )
    if s.optimizer.preintegration_s > s.optimizer.knot_s:
        raise ConfigError(f"{source}: optimizer.preintegration_s: must not exceed optimizer.knot_s")
    if s.ingest.mode == "event" and s.ingest.selection != "burst":
        raise ConfigError(f"{source}: ingest.selection: must be 'burst' with ingest.mode = 'event'")
    if s.ingest.refractory_ms >= s.ingest.memory_ms:
        raise ConfigError(f"{source}: ingest.refractory_ms: must be below ingest.memory_ms")


def to_tree(settings: Settings) -> dict[str, dict[str, Any]]:
    """Nested dicts; ``from_tree(to_tree(s)) == s``."""
    return {
        section.name: {
            f.name: getattr(getattr(settings, section.name), f.name) for f in fields(getattr(settings, section.name))
        }
        for section in fields(settings)
    }


def to_toml(settings: Settings, explain: bool = True) -> str:
    """TOML text that ``loads`` reads back to equal settings; with a comment above each key."""
    lines: list[str] = []
    for section in fields(settings):
        part = getattr(settings, section.name)
        lines += ["", f"[{section.name}]"]
        for f in fields(part):
            if explain:
                lines.append(f"# {_explain(f)}")
            lines.append(f"{f.name} = {_toml_value(getattr(part, f.name))}")
    return "\n".join(lines[1:]) + "\n"


def _explain(f: Any) -> str:
    m = f.metadata
    default = "" if f.default is MISSING else f" (default {_toml_value(f.default)})"
    return f"{m['doc']}{default}"


def _toml_value(v: Any) -> str:
    if isinstance(v, bool):
        return "true" if v else "false"
    if isinstance(v, str):
        # TOML's basic strings escape as JSON's do.
        return json.dumps(v, ensure_ascii=False)
    return repr(v)
