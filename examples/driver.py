"""A sensor driver with nothing of velod: only eclipse-zenoh, msgpack and numpy. docs/driver.md explains each step.

    velod run -c velod.toml                        in another terminal
    python examples/driver.py [tcp/HOST:17447]

The "camera" below sees a bar that moves to the right at 100 px/s, and the "IMU" lies still: take their place with
the calls of your camera's SDK.
"""

import contextlib
import json
import sys
import time

import msgpack
import numpy as np
import zenoh

RIG = "rig0"
PERIOD_NS = 5_000_000  # a packet every 5 ms of sensor time
NOISE = np.random.default_rng(1)


def event_packet(seq, watermark_ns, camera, t_ns, x, y, p):
    """Events of one camera: t_ns non-decreasing, all events before watermark_ns, none of them sent before."""
    t0_ns = int(t_ns[0]) if len(t_ns) else watermark_ns
    return msgpack.packb(
        {
            "schema": "velod.EventPacket",
            "v": 1,
            "seq": seq,
            "t_ns": watermark_ns,
            "t_pub_ns": time.time_ns(),
            "t_origin_ns": 0,
            "camera": camera,
            "t0_ns": t0_ns,
            "dt": (t_ns - t0_ns).astype("<u4").tobytes(),
            "x": x.astype("<u2").tobytes(),
            "y": y.astype("<u2").tobytes(),
            "p": p.astype("u1").tobytes(),
        }
    )


def imu_packet(seq, t_ns, accel, gyro):
    """IMU samples: accel (n, 3) in m/s^2 with +9.81 upwards at rest, gyro (n, 3) in rad/s."""
    return msgpack.packb(
        {
            "schema": "velod.ImuPacket",
            "v": 1,
            "seq": seq,
            "t_ns": int(t_ns[-1]),
            "t_pub_ns": time.time_ns(),
            "t_origin_ns": 0,
            "sample_t_ns": t_ns.astype("<i8").tobytes(),
            "accel": accel.astype("<f8").tobytes(),
            "gyro": gyro.astype("<f8").tobytes(),
        }
    )


def read_camera(camera, start_ns, end_ns):
    """Stands for your SDK: the events of start_ns <= t < end_ns."""
    y = np.arange(260)
    column = int(start_ns * 100e-9) % 340
    column -= 8 if camera == "right" and column >= 8 else 0
    t_ns = np.linspace(start_ns, end_ns - 1, len(y)).astype(np.int64)
    return t_ns, np.full(len(y), column), y, np.ones(len(y))


def read_imu(start_ns):
    """Stands for your SDK: one sample of a camera that lies level and still (y points down)."""
    # Noise, as any real IMU has: velod takes one that repeats itself for frozen.
    accel, gyro = NOISE.normal(0.0, 0.02, (2, 1, 3))
    return np.array([start_ns]), accel + np.array([0.0, -9.81, 0.0]), gyro


def main():
    endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:17447"
    config = {
        "mode": "peer",
        "connect": {"endpoints": [endpoint], "timeout_ms": -1, "exit_on_failure": False},
        "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        # A sensor's stream must not stall the driver: drop when the network cannot follow. velod counts the gaps.
        drop = {"congestion_control": zenoh.CongestionControl.DROP}
        sides = ("left", "right")
        events = {side: session.declare_publisher(f"velod/{RIG}/sensor/events/{side}", **drop) for side in sides}
        imu = session.declare_publisher(f"velod/{RIG}/sensor/imu", **drop)
        started_s = time.monotonic()
        for seq in range(sys.maxsize):
            start_ns, end_ns = seq * PERIOD_NS, (seq + 1) * PERIOD_NS
            time.sleep(max(0.0, started_s + end_ns * 1e-9 - time.monotonic()))
            for side in sides:
                events[side].put(event_packet(seq, end_ns, side, *read_camera(side, start_ns, end_ns)))
            imu.put(imu_packet(seq, *read_imu(start_ns)))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
