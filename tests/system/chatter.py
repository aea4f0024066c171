"""A peer that says 2 kB every 5 ms and listens to others: ``chatter.py ENDPOINT NAME SECONDS``.

The one called ``hub`` listens at the endpoint and hears everybody; all others hear it alone. In the end a line of
JSON: the longest silence of each one that was heard, s.
"""

from __future__ import annotations

import json
import sys
import time

import zenoh

from velod.config import ZenohSettings
from velod.runtime.session import open_session

HUB = "hub"


def main() -> None:
    endpoint, name, seconds = sys.argv[1:]
    is_hub = name == HUB
    where = (
        ZenohSettings(listen=endpoint, insecure=True) if is_hub else ZenohSettings(connect=endpoint, insecure=True)
    )
    heard_s: dict[str, float] = {}
    silence_s: dict[str, float] = {}

    def heard(sample: zenoh.Sample) -> None:
        who, now_s = str(sample.key_expr).rpartition("/")[2], time.monotonic()
        silence_s[who] = max(silence_s.get(who, 0.0), now_s - heard_s.get(who, now_s))
        heard_s[who] = now_s

    with open_session(where, introducer=is_hub) as session:
        callback = zenoh.handlers.Callback(heard, indirect=False)
        session.declare_subscriber("chatter/*/*" if is_hub else f"chatter/{HUB}", callback)
        own = f"chatter/{HUB}" if is_hub else f"chatter/of/{name}"
        publisher = session.declare_publisher(own, congestion_control=zenoh.CongestionControl.DROP)
        end_s = time.monotonic() + float(seconds)
        while time.monotonic() < end_s:
            publisher.put(bytes(2000))
            time.sleep(0.005)
        print(json.dumps(silence_s), flush=True)


if __name__ == "__main__":
    main()
