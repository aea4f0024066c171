"""Session settings: who listens where, and errors that name the endpoint."""

from __future__ import annotations

from pathlib import Path

import pytest

from velod.config import ZenohSettings
from velod.runtime import session
from velod.runtime.session import SessionError, introducer_endpoint, open_session


def test_the_introducer_of_one_host_listens_on_loopback_alone() -> None:
    assert session._introducer_listens(ZenohSettings(port=1234)) == ["tcp/127.0.0.1:1234"]


def test_further_endpoints_are_for_other_hosts_and_do_not_bind_a_port_twice() -> None:
    both = ZenohSettings(port=1234, listen="tcp/192.168.1.5:1234")
    assert session._introducer_listens(both) == ["tcp/127.0.0.1:1234", "tcp/192.168.1.5:1234"]
    assert session._peer_listens(both) == ["tcp/127.0.0.1:0", "tcp/192.168.1.5:0"]
    wildcard = ZenohSettings(port=1234, listen="tcp/0.0.0.0:1234")
    assert session._introducer_listens(wildcard) == ["tcp/0.0.0.0:1234"]
    assert session._peer_listens(wildcard) == ["tcp/0.0.0.0:0"]


def test_a_worker_far_away_listens_where_the_service_can_reach_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        session, "_address_towards", lambda host, port: {"far": "10.0.0.7", "near": "127.0.0.1"}[host]
    )
    assert session._peer_listens(ZenohSettings(connect="tcp/far:17447")) == ["tcp/127.0.0.1:0", "tcp/10.0.0.7:0"]
    assert session._peer_listens(ZenohSettings(connect="tcp/near:17447")) == ["tcp/127.0.0.1:0"]


def test_workers_find_the_introducer_by_port_or_by_endpoint() -> None:
    assert introducer_endpoint(ZenohSettings(port=5)) == "tcp/127.0.0.1:5"
    assert introducer_endpoint(ZenohSettings(port=5, connect="tcp/host:6")) == "tcp/host:6"


@pytest.mark.parametrize("endpoint", ["host:17447", "tcp/host", "tcp/host:0", "tcp/host:70000", "tcp/:17447"])
def test_a_malformed_endpoint_is_refused_by_name(endpoint: str) -> None:
    with pytest.raises(SessionError, match=r"zenoh\.connect: must be an endpoint such as tcp/"):
        open_session(ZenohSettings(connect=endpoint))


def test_a_missing_or_broken_configuration_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"absent\.json5: no such file"):
        open_session(ZenohSettings(config=str(tmp_path / "absent.json5")))
    broken = tmp_path / "broken.json5"
    broken.write_text("{ mode: ")
    with pytest.raises(SessionError, match=r"broken\.json5: not a zenoh configuration"):
        open_session(ZenohSettings(config=str(broken)))


def test_a_panic_of_zenoh_for_want_of_shared_memory_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    panic = type("PanicException", (BaseException,), {})

    def fail(_: object) -> None:
        raise panic(
            "called `Result::unwrap()` on an `Err` value: Unable to create POSIX shm segment: OS error 12 at x"
        )

    monkeypatch.setattr(session.zenoh, "open", fail)
    with pytest.raises(SessionError, match=r"no shared memory: .* zenoh\.shared_memory = false"):
        open_session(ZenohSettings())


def test_without_shared_memory_none_is_touched() -> None:
    assert session.peer_tree([], [], shared_memory=False)["transport"]["shared_memory"]["mode"] == "lazy"
