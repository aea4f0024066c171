"""Offset and drift of a sensor's clock, recovered from delayed arrivals."""

from __future__ import annotations

import numpy as np
import pytest

from velod.runtime.sensor_clock import DRIFT_AFTER, SensorClockFit

OFFSET_S, DRIFT_PPM = 1_700_000_000.25, 40.0


def fit(seconds: float, stalls: bool = False) -> SensorClockFit:
    """200 packets a second with delays of 2 ms on average; with ``stalls`` every fifth second is 0.3 s late."""
    rng = np.random.default_rng(5)
    clock = SensorClockFit()
    for t_s in np.arange(0.0, seconds, 0.005):
        delay_s = rng.exponential(2e-3) + (0.3 if stalls and int(t_s) % 5 == 2 else 0.0)
        host_s = t_s * (1.0 + 1e-6 * DRIFT_PPM) + delay_s
        clock.heard(round(t_s * 1e9), round(OFFSET_S * 1e9) + round(host_s * 1e9))
    return clock


@pytest.mark.parametrize("stalls", [False, True])
def test_drift_and_offset_are_recovered_whatever_the_delays(stalls: bool) -> None:
    gauges = fit(60.0, stalls).gauges()
    assert gauges["clock.drift_ppm"] == pytest.approx(DRIFT_PPM, abs=1.0)
    # At the newest second the clocks have parted by 40 ppm of a minute.
    assert gauges["clock.offset_s"] == pytest.approx(OFFSET_S + 59.5 * 1e-6 * DRIFT_PPM, abs=2e-4)


def test_a_drift_is_told_only_after_a_while() -> None:
    assert set(fit(DRIFT_AFTER - 2.0).gauges()) == {"clock.offset_s"}
    assert SensorClockFit().gauges() == {}


def test_a_clock_that_is_set_back_begins_anew() -> None:
    clock = fit(20.0)
    clock.heard(0, 5_000_000_000)
    assert clock.gauges() == {"clock.offset_s": 5.0}
