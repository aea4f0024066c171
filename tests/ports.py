"""Ports that nobody listens on."""

import socket
from contextlib import ExitStack


def free_ports(n: int) -> list[int]:
    """``n`` of them, all different."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(n)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]
