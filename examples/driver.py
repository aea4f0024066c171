"""A sensor driver with nothing of velod: only eclipse-zenoh, msgpack and numpy. docs/driver.md explains each step.

    velod run --calibration examples/rig.yaml      in another terminal
    python examples/driver.py [tcp/HOST:17447]
    velod echo                                     in a third one: 1.25 m/s along -x

The "cameras" below see slanted edges that move to the right at 100 px/s and 8 px of disparity, and the "IMU" feels no
acceleration, so the rig moves to the left at 1.25 m/s. Take their place with the calls of your camera's SDK.
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

# When an edge reaches each pixel; the next one follows 64 px or 0.64 s behind. They lean to the right in the upper
# half of the image and to the left in the lower half: edges of one direction would show motion across it only.
ROW, COLUMN = np.mgrid[:260, :346]
EDGE_PERIOD_NS = 640_000_000
REACHED_NS = (((COLUMN + np.where(ROW < 130, 0.5, -0.5) * ROW) * 10e6).astype(np.int64) % EDGE_PERIOD_NS).ravel()
ORDER = np.argsort(REACHED_NS, kind="stable")
DISPARITY_NS = {"left": 0, "right": 80_000_000}


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
    # A packet never reaches over the end of a period, which is a whole number of packets long.
    phase_ns = (start_ns - DISPARITY_NS[camera]) % EDGE_PERIOD_NS
    first, last = np.searchsorted(REACHED_NS, [phase_ns, phase_ns + end_ns - start_ns], sorter=ORDER)
    pixels = ORDER[first:last]
    y, x = np.divmod(pixels, COLUMN.shape[1])
    return start_ns + REACHED_NS[pixels] - phase_ns, x, y, np.ones(len(pixels))


def read_imu(start_ns):
    """Stands for your SDK: one sample of a level rig without acceleration (y points down)."""
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
