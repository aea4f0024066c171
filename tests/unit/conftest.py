"""A real Zenoh session, for what runs in one process."""

from collections.abc import Iterator

import pytest
import zenoh

from velod.config import ZenohSettings
from velod.runtime.session import open_session


@pytest.fixture
def session(port: int) -> Iterator[zenoh.Session]:
    """On a port of its own."""
    with open_session(ZenohSettings(port=port), introducer=True) as opened:
        yield opened
