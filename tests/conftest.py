"""What all tests share: hypothesis' settings, simulated recordings, free ports."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.ports import free_ports
from velod.sim import simulated_recording

# Every run tries the same examples; a slow machine is not a failure.
settings.register_profile("velod", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("velod")


@pytest.fixture(scope="session")
def simulated(pytestconfig: pytest.Config) -> Callable[[str, float], Path]:
    """Makes recordings of simulated sequences: ``simulated("corridor-1", 0.6)``; kept in pytest's cache."""

    def make(name: str, seconds: float) -> Path:
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("VELOD_CACHE_DIR", str(pytestconfig.cache.mkdir("velod")))
            return simulated_recording(name, seconds, seed=1)

    return make


@pytest.fixture
def port() -> int:
    """A port that nobody listens on."""
    return free_ports(1)[0]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run the tests marked long, too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--long"):
        for item in items:
            if "long" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="long: runs with --long only"))
