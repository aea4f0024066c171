"""Lines for people: what they say."""

from __future__ import annotations

import math
import sys
import time

import numpy as np
import pytest

from velod.cli.line import Line, progress_bar
from velod.cli.place import Place
from velod.cli.played import Played, shortcomings
from velod.cli.top import losses, table
from velod.cli.watch import describe
from velod.cli.words import describe_velocity, speed_and_sigma
from velod.client import Received
from velod.config import ZenohSettings
from velod.eval.metrics import Metrics
from velod.types import Health, ImuPacket, Message, Velocity
from velod.wire import Envelope
from velod.wire.topics import HEALTH, IMU_SENSOR


def velocity(valid: bool = True) -> Velocity:
    return Velocity(
        seq=0,
        t_ns=12_345_000_000,
        v_B=np.array([3.0, 0.0, 4.0]),
        cov=np.diag([0.04, 9.0, 0.01]),
        valid=valid,
        state="tracking" if valid else "initialising",
        reason="" if valid else "no batch yet",
        batch_seq=0,
        batch_t_ns=0,
    )


def test_a_velocity_is_told_with_the_sigma_of_its_length() -> None:
    speed, sigma = speed_and_sigma(velocity())
    assert speed == 5.0
    # First order: u^T P u with u = (0.6, 0, 0.8).
    assert sigma == pytest.approx(math.sqrt(0.36 * 0.04 + 0.64 * 0.01))
    line = describe_velocity(velocity(), rate_hz=75.0, latency_ms=8.1)
    told = "t    12.345 s  |v|  5.000 ± 0.144 m/s  [+3.000 +0.000 +4.000]   75.0 Hz    8.1 ms  tracking"
    assert line == told


def test_an_invalid_velocity_shows_no_number_but_the_reason() -> None:
    assert describe_velocity(velocity(valid=False)).endswith("|v|    --  initialising: no batch yet")


def test_a_standing_rig_has_a_sigma_too() -> None:
    still = Velocity(0, 0, np.zeros(3), 0.01 * np.eye(3), True, "tracking", "", 0, 0)
    assert speed_and_sigma(still) == (0.0, pytest.approx(0.1))


def test_the_progress_bar_fills_and_tells_what_is_left() -> None:
    assert progress_bar(0.0, 1.0, width=4) == "[....]   0 %"
    assert progress_bar(0.5, 6.0, width=4) == "[##..]  50 %     6 s left"
    assert progress_bar(1.5, 6.0, width=4) == "[####] 100 %     0 s left"


def test_nothing_is_redrawn_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    line = Line()
    assert not line.due()
    line.log_trouble("12:00:00 flow-0 INFO up")
    line.log_trouble("12:00:00 flow-0 WARNING slow")
    line.finish()
    assert capsys.readouterr().err == "12:00:00 flow-0 WARNING slow\n"


def test_a_log_line_is_written_above_the_live_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    line = Line()
    assert line.due()
    line.draw("live")
    assert not line.due()
    line.log("flow-0 died")
    line.finish()
    assert capsys.readouterr().err == "\r\x1b[Klive\r\x1b[Kflow-0 died\nlive\n"


@pytest.mark.parametrize(
    ("samples", "shown"),
    [(1, "accel=[0.1 0 9.81]"), (5, "accel=float64[5, 3](0..9.81)"), (0, "accel=[]")],
)
def test_arrays_are_echoed_as_numbers_where_they_are_few_and_else_by_shape_and_range(
    samples: int, shown: str
) -> None:
    accel = np.tile([0.1, 0.0, 9.81], (samples, 1))
    packet: Message = ImuPacket(0, 5, np.arange(samples, dtype=np.int64), accel, accel)
    assert shown in describe(Received(IMU_SENSOR, "key", Envelope(packet, 1, 0), 1, 100))


def test_losses_are_told_from_counts_of_work() -> None:
    counters = {
        "in.events": 9,
        "out.imu": 9,
        "batches": 4,
        "points.refined": 7,
        "flow.rms": 3,
        "bridge.begun": 1,
        "wire.truncated": 0,
        "gap.events": 1,
        "packets.gap": 2,
        "events.outside": 3,
        "wire.version_alien": 4,
        "error.KeyError": 5,
    }
    gaps, drops = losses(counters)
    assert gaps == {"gap.events": 1, "packets.gap": 2}
    assert drops == {"events.outside": 3, "wire.version_alien": 4, "error.KeyError": 5}


def health(
    worker: str, age_s: float, **changes: dict[str, float] | dict[str, int] | dict[str, str] | str
) -> Received:
    now_ns = time.time_ns()
    message = Health(0, 0, worker.split("-")[0], worker, 42, "host", "0.1.0", 12.0, **changes)  # type: ignore[arg-type]
    return Received(HEALTH, "key", Envelope(message, now_ns, 0), now_ns - int(age_s * 1e9), 100)


def test_the_table_tells_who_is_up_stale_gone_or_silent_and_what_they_lost() -> None:
    newest = {
        "flow-0": health(
            "flow-0",
            0.1,
            counters={"gap.batch_flow": 2, "wire.truncated": 1, "in.batch_flow": 500},
            rates={"in.batch_flow": 50.0, "out.flow": 49.0},
            latency_ms={"stage_p50": 1.25, "stage_p99": 4.5},
            alarms={"cpu": "too slow"},
        ),
        "optimizer-0": health("optimizer-0", 0.1),
        "optimizer-1": health("optimizer-1", 0.1, role="standby"),
        "ingest-0": health("ingest-0", 60.0, rates={"sent.flow-0": 30.0, "sent.flow-1": 10.0, "sent.depth-0": 40.0}),
    }
    text = table(
        Place("rig0", ZenohSettings(connect="tcp/h:1")),
        newest,
        [("flow", "flow-0"), ("depth", "depth-0"), ("optimizer", "optimizer-1")],
    )
    rows = {line.split()[0]: line.split() for line in text.splitlines()[2:]}
    assert rows["flow-0"] == ["flow-0", "up", "42@host", "12", "50.0", "49.0", "1.25", "4.50", "2", "1", "stage"]
    assert (rows["optimizer-0"][1], rows["ingest-0"][1], rows["depth-0"][1]) == ("gone", "stale", "silent")
    assert rows["optimizer-1"][1] == "standby"
    assert "    flow: flow-0 75%, flow-1 25%\n" in text and "    depth: depth-0 100%\n" in text
    assert "    gap.batch_flow: 2" in text and "    wire.truncated: 1" in text and "    ALARM cpu: too slow" in text


def metrics(ave_mps: float, valid_fraction: float) -> Metrics:
    return Metrics(
        n=100,
        ave_mps=ave_mps,
        rve_percent=1.0,
        rve_quartiles_percent=(0.5, 0.9, 1.2),
        rve_p95_percent=2.0,
        median_mps=0.01,
        p95_mps=0.1,
        max_mps=0.2,
        first_valid_s=0.1,
        valid_fraction=valid_fraction,
        nees_mean=3.0,
        within_1_sigma=0.2,
        within_2_sigma=0.74,
        within_3_sigma=0.97,
        median_speed_mps=5.0,
        median_true_speed_mps=5.0,
    )


def played(rate_hz: float) -> Played:
    step_ns = int(1e9 / rate_hz)
    published = [
        Velocity(i, i * step_ns, np.zeros(3), np.eye(3), True, "tracking", "", 0, 0) for i in range(int(rate_hz))
    ]
    return Played(None, published, 1.0, offline=False)  # type: ignore[arg-type]


def test_a_demo_that_falls_short_says_in_what() -> None:
    assert shortcomings(played(75.0), metrics(0.05, 1.0), 75.0, 0.1) == []
    assert shortcomings(played(75.0), metrics(0.11, 1.0), 75.0, 0.1) == ["AVE 0.110 m/s, at most 0.1 belongs there"]
    text = "; ".join(shortcomings(played(50.0), metrics(float("nan"), 0.5), 75.0, 0.1))
    assert "AVE nan m/s" in text and "only 50 %" in text and "50.0 velocities per second instead of 75" in text
