"""Print the velocity with nothing of velod: only eclipse-zenoh and msgpack.

    python examples/consumer.py [tcp/HOST:17447]

The same in any language that has Zenoh and msgpack; docs/messages.md describes every message.
"""

import contextlib
import json
import struct
import sys

import msgpack
import zenoh

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:17447"
config = zenoh.Config.from_json5(
    json.dumps(
        {
            "mode": "peer",
            "connect": {"endpoints": [endpoint], "timeout_ms": 0},
            "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
            # velod's processes tell each other of themselves by gossip; without it nothing arrives.
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
        }
    )
)

# The ring keeps the newest messages: a slow consumer loses old ones instead of being served them late.
with (
    contextlib.suppress(KeyboardInterrupt),
    zenoh.open(config) as session,
    session.declare_subscriber("velod/rig0/velocity", zenoh.handlers.RingChannel(8)) as subscriber,
):
    for sample in subscriber:
        message = msgpack.unpackb(sample.payload.to_bytes())
        if message["schema"] != "velod.Velocity" or message["v"] != 1:
            print(f"not a velocity of version 1: {message['schema']} v{message['v']}", file=sys.stderr)
        elif message["valid"]:
            v = struct.unpack("<3d", message["v_B"])  # m/s, body frame
            cov = struct.unpack("<9d", message["cov"])  # (m/s)^2, row-major
            sigma = [cov[i] ** 0.5 for i in (0, 4, 8)]
            print(message["t_ns"], *(f"{a:+.3f}±{s:.3f}" for a, s in zip(v, sigma, strict=True)), flush=True)
