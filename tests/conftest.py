"""What all tests share: hypothesis' settings, simulated recordings, free ports; and how they are shared out."""

import fcntl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    kept = pytestconfig.cache.mkdir("velod")

    def make(name: str, seconds: float) -> Path:
        with alone(kept / f"{name}-{seconds:g}.lock"), pytest.MonkeyPatch.context() as environment:
            environment.setenv("VELOD_CACHE_DIR", str(kept))
            return simulated_recording(name, seconds, seed=1)

    return make


@contextmanager
def alone(lock: Path) -> Iterator[None]:
    """One test process at a time: the others wait for what it makes."""
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@pytest.fixture
def port() -> int:
    """A port that nobody listens on."""
    return free_ports(1)[0]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run the tests marked long, too")


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--long"):
        for item in items:
            if "long" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="long: runs with --long only"))
    if config.getoption("dist", "no") == "loadgroup":
        share_out(items)


def share_out(items: list[pytest.Item]) -> None:
    """Real processes one test after the other, from the beginning on; beside them the rest, file by file."""
    items.sort(key=lambda item: "system" not in item.keywords)
    for item in items:
        item.add_marker(pytest.mark.xdist_group("system" if "system" in item.keywords else item.path.stem))
