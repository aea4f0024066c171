"""Real-sensor effects: the statistics of each, and that a recording with all of them is one that velod reads."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from velod.cli import main
from velod.cli.stages import true_depth_of
from velod.geometry.camera import distort, normalised, pixels
from velod.io import EventColumns, open_recording
from velod.sim import sequence, simulate
from velod.sim.cast import rays_of
from velod.sim.effects import BUS_BUFFER_US, HOT_HZ, Effects, Noise, Readout, SensorError
from velod.sim.events import LOG_EPS, EventModel, EventSensor
from velod.sim.imu import ImuModel

WIDTH, HEIGHT = 100, 80
EXACT = EventModel(threshold=0.5, threshold_sigma=0.0, refractory_us=0)
WHOLE = np.array([[0, HEIGHT, 0, WIDTH]])


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def watch(effects: Effects, intensities: list[float], step_us: int) -> EventColumns:
    """Events of images of one intensity each, ``step_us`` apart."""
    sensor = EventSensor(EXACT, effects, WIDTH, HEIGHT, rng())
    sensor.start(np.full((HEIGHT, WIDTH), intensities[0], np.float32))
    for k, value in enumerate(intensities[1:]):
        view = np.full((HEIGHT, WIDTH), value, np.float32)
        sensor.see(view, WHOLE, np.array([k * step_us]), (k + 1) * step_us)
    return sensor.take(0, (len(intensities) - 1) * step_us)


def stream(n: int, rate_mev_s: float) -> EventColumns:
    """Events at even distances."""
    t_ns = np.arange(n, dtype=np.int64) * round(1e3 / rate_mev_s)
    return EventColumns(t_ns, np.arange(n).astype(np.uint16), np.zeros(n, np.uint16), np.zeros(n, np.uint8))


def read_in_batches(effects: Effects, events: EventColumns, clock_offset_us: int = 0) -> EventColumns:
    """As ``simulate`` reads out: batch by batch, then the rest."""
    readout, parts = Readout(effects, clock_offset_us, rng()), []
    edges_us = [*range(0, int(events.t_ns[-1] // 1000) + 1000, 1000)]
    for from_us, to_us in pairwise(edges_us):
        rows = (events.t_ns > from_us * 1000) & (events.t_ns <= to_us * 1000)
        rows |= (events.t_ns == 0) & (from_us == 0)
        batch = EventColumns(events.t_ns[rows], events.x[rows], events.y[rows], events.p[rows])
        parts.append(readout.read(batch, to_us))
    nothing = EventColumns(events.t_ns[:0], events.x[:0], events.y[:0], events.p[:0])
    parts.append(readout.read(nothing, None))
    return EventColumns(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "x", "y", "p"))
    )


def test_background_noise_has_its_rate_everywhere_and_both_polarities() -> None:
    got = Noise(Effects(noise_hz=2.0), WIDTH, HEIGHT, rng()).between(0, 5_000_000)
    assert len(got.t_ns) == pytest.approx(2.0 * WIDTH * HEIGHT * 5, rel=0.02)
    assert got.p.mean() == pytest.approx(0.5, abs=0.01)
    per_pixel = np.bincount(got.y.astype(int) * WIDTH + got.x, minlength=WIDTH * HEIGHT)
    # Poisson: the variance is the mean.
    assert per_pixel.var() == pytest.approx(10.0, rel=0.1)
    assert np.all(np.diff(got.t_ns) >= 0)


def test_hot_pixels_are_a_share_of_all_and_fire_at_their_rate() -> None:
    got = Noise(Effects(hot_share=0.005), WIDTH, HEIGHT, rng()).between(0, 1_000_000)
    per_pixel = np.bincount(got.y.astype(int) * WIDTH + got.x, minlength=WIDTH * HEIGHT)
    assert (per_pixel > 0).sum() == round(0.005 * WIDTH * HEIGHT)
    assert per_pixel[per_pixel > 0].mean() == pytest.approx(HOT_HZ, rel=0.02)


def test_a_leak_gives_on_events_at_its_rate_where_nothing_changes() -> None:
    got = watch(Effects(leak_hz=2.0), [0.3] * 2001, 1000)
    assert set(got.p.tolist()) == {1}
    # The fourth is due at the very end.
    times_ms = sorted(set((got.t_ns // 1_000_000).tolist()))
    assert len(got.t_ns) in (3 * WIDTH * HEIGHT, 4 * WIDTH * HEIGHT)
    assert np.allclose(times_ms[:3], [500, 1000, 1500], atol=2)


def test_a_slow_pixel_follows_a_step_exponentially_and_in_the_dark_more_slowly() -> None:
    bandwidth_hz, step_us = 100.0, 50
    arrivals_s = []
    for dark in (0.02, 0.2):
        bright = (dark + LOG_EPS) * np.exp(1.0) - LOG_EPS
        got = watch(Effects(bandwidth_hz=bandwidth_hz), [dark] + [bright] * 1000, step_us)
        first_s = float(got.t_ns.min()) * 1e-9
        light = (bright + 1.0 / 12.0) / (1.0 + 1.0 / 12.0)
        # Half of a step of 1: after ln 2 time constants.
        assert first_s == pytest.approx(np.log(2.0) / (2 * np.pi * bandwidth_hz * light), rel=0.03)
        arrivals_s.append(first_s)
    assert arrivals_s[0] > 2 * arrivals_s[1]


def test_jitter_has_its_sigma_and_the_stamps_stay_in_order() -> None:
    events = stream(40_000, 2.0)
    got = read_in_batches(Effects(jitter_us=30.0), events)
    assert len(got.t_ns) > 0.998 * len(events.t_ns)  # none but stamps before zero are lost
    assert np.all(np.diff(got.t_ns) >= 0)
    off_us = (got.t_ns - events.t_ns[got.x.astype(int)]) / 1000
    inside = got.x > 1000
    assert off_us[inside].std() == pytest.approx(30.0, rel=0.03)
    assert abs(off_us[inside].mean()) < 1.0


def test_stamps_are_multiples_of_the_quantum_rounded_down() -> None:
    events = stream(10_000, 1.0)
    got = read_in_batches(Effects(quantum_us=200), events)
    assert np.all(got.t_ns % 200_000 == 0)
    assert np.array_equal(got.t_ns, events.t_ns[got.x.astype(int)] // 200_000 * 200_000)
    assert len(got.t_ns) == len(events.t_ns)


def test_a_bus_that_is_fast_enough_delays_by_its_own_time_and_loses_nothing() -> None:
    events = stream(10_000, 1.0)
    got = read_in_batches(Effects(bus_mev_s=2.0), events)
    assert len(got.t_ns) == len(events.t_ns)
    assert np.abs(got.t_ns - events.t_ns - 500).max() < 1000  # stamps are whole microseconds


def test_a_saturated_bus_reads_out_what_it_can_late_and_loses_the_rest() -> None:
    events = stream(40_000, 4.0)  # 10 ms
    got = read_in_batches(Effects(bus_mev_s=1.0), events)
    # What it reads out in 10 ms, and what then still waits.
    assert len(got.t_ns) == pytest.approx(10_000 + BUS_BUFFER_US, rel=0.01)
    late_us = (got.t_ns - events.t_ns[got.x.astype(int)]) / 1000
    assert late_us.max() <= BUS_BUFFER_US
    assert late_us[len(late_us) // 2 :].mean() > 0.98 * BUS_BUFFER_US
    assert np.all(np.diff(got.t_ns) >= 0)


def test_a_clock_offset_moves_the_right_camera_s_stamps() -> None:
    events = stream(5000, 1.0)
    ahead, behind = (read_in_batches(Effects(), events, offset_us) for offset_us in (300, -300))
    assert np.array_equal(ahead.t_ns, events.t_ns + 300_000)
    # A clock that is behind has not started yet.
    assert np.array_equal(behind.t_ns, events.t_ns[300:] - 300_000)


def test_a_distorted_lens_looks_where_its_calibration_says() -> None:
    recipe = replace(sequence("boxes-4"), effects=Effects(radtan=(-0.3, 0.1, 1e-3, -5e-4, 0.0)))
    camera = recipe.calibration.left
    rays = rays_of(camera).astype(np.float64)
    j, i = np.mgrid[:260:37, :346:43]
    seen = pixels(distort(rays[:, j, i].reshape(2, -1).T, camera)[0], camera)
    assert np.allclose(seen, np.stack([i.ravel(), j.ravel()], axis=1), atol=1e-3)
    corner = normalised(np.zeros((1, 2)), camera)[0]
    assert np.linalg.norm(rays[:, 0, 0]) > 1.1 * np.linalg.norm(corner)


def test_a_recording_with_every_effect_is_one_that_velod_reads(tmp_path: Path) -> None:
    path = tmp_path / "rough.h5"
    options = (
        "--noise 1 --hot-pixels 0.001 --leak 0.1 --bandwidth 300 --jitter 20 --quantum 200 --bus 2 --clock-offset 300"
        " --threshold-spread 0.03 --imu-hz 1000 --distortion=-0.35,0.15,0,0,0"
    )
    assert main(["sim", "boxes-4", "-o", str(path), "--seconds", "0.1", *options.split()]) == 0
    recording = open_recording(path)
    assert recording.calibration.left.model == "radtan"
    assert recording.calibration.left.dist == (-0.35, 0.15, 0.0, 0.0, 0.0)
    assert len(recording.imu.t_ns) == 101
    with h5py.File(path) as file:
        for side in ("left", "right"):
            t_us = file[f"events/{side}/t"][:]
            assert np.all(np.diff(t_us) >= 0)
            assert 1e4 < len(t_us) < 2e6 * 0.11
        assert np.all(file["events/left/t"][:] % 200 == 0)
    # Whatever the lens and the sensors do, the simulator knows its own scene.
    true_depth = true_depth_of(recording)
    assert true_depth is not None and "ray casting" in true_depth.how


def test_a_lower_threshold_fires_more_often(tmp_path: Path) -> None:
    counts = []
    for threshold in ("0.25", "0.5"):
        path = tmp_path / f"{threshold}.h5"
        assert main(["sim", "corridor-1", "-o", str(path), "--seconds", "0.03", "--threshold", threshold]) == 0
        counts.append(open_recording(path).n_events)
    assert counts[0] > 1.5 * counts[1] > 0


def test_effects_that_are_off_change_nothing(tmp_path: Path) -> None:
    recipe = sequence("corridor-1")
    simulate(recipe, 0.01, 1, tmp_path / "plain.h5")
    simulate(replace(recipe, effects=Effects(clock_offset_us=40)), 0.01, 1, tmp_path / "late.h5")
    with h5py.File(tmp_path / "plain.h5") as plain, h5py.File(tmp_path / "late.h5") as late:
        assert len(plain["events/left/t"]) > 0
        assert np.array_equal(plain["events/left/t"][:], late["events/left/t"][:])
        assert np.array_equal(plain["events/right/t"][:] + 40, late["events/right/t"][:])


@pytest.mark.parametrize(
    "values", [{"noise_hz": -1.0}, {"bus_mev_s": float("nan")}, {"hot_share": 1.5}, {"radtan": (0.1, 0.2)}]
)
def test_effects_that_cannot_be_are_refused_by_name(values: dict[str, float]) -> None:
    with pytest.raises(SensorError, match=next(iter(values))):
        Effects(**values)  # type: ignore[arg-type]


def test_an_imu_rate_that_is_no_whole_number_of_microseconds_is_refused() -> None:
    with pytest.raises(SensorError, match="must divide 1,000,000 Hz, got 300"):
        ImuModel(rate_hz=300)
