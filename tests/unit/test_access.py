"""What each role may do, as the list says that Zenoh enforces: nothing that no rule allows."""

from __future__ import annotations

from typing import Any

import pytest

from velod.runtime.access import RIGHTS, ROLES, access_control, common_name, may_read, size_limits
from velod.wire.schema import MAX_BYTES
from velod.wire.topics import EVENTS, FLOW, HEALTH, ODOMETRY, TOPICS, VELOCITY, key


def allowed(tree: dict[str, Any], subject: str, flow: str, message: str) -> set[str]:
    """The keys on which the policies allow a message."""
    named = {s["id"] for s in tree["subjects"] if subject in s.get("cert_common_names", [])}
    granted = {rule for p in tree["policies"] if named & set(p["subjects"]) for rule in p["rules"]}
    return {
        k
        for rule in tree["rules"]
        if rule["id"] in granted and flow in rule["flows"] and message in rule["messages"]
        for k in rule["key_exprs"]
    }


def test_what_is_not_allowed_is_denied_and_no_rule_denies() -> None:
    tree = access_control()
    assert tree["enabled"] and tree["default_permission"] == "deny"
    assert {rule["permission"] for rule in tree["rules"]} == {"allow"}


def test_only_workers_publish_velocity_and_drivers_and_consumers_cannot_read_what_is_not_theirs() -> None:
    tree = access_control()
    velocity = key(VELOCITY, "*")
    publishers = {role for role in ROLES if velocity in allowed(tree, common_name(role), "ingress", "put")}
    readers = {
        role for role in ROLES if velocity in allowed(tree, common_name(role), "ingress", "declare_subscriber")
    }
    assert publishers == {"worker"} and readers == {"worker", "consumer", "operator"}
    assert not allowed(tree, common_name("consumer"), "ingress", "put")
    assert not allowed(tree, common_name("driver"), "egress", "put")
    assert key(EVENTS, "*") in allowed(tree, common_name("driver"), "ingress", "put")
    raw = {role for role in ROLES if key(EVENTS, "*") in allowed(tree, common_name(role), "egress", "put")}
    assert raw == {"worker"}


def test_a_certificate_for_one_rig_is_good_for_that_rig_alone() -> None:
    tree = access_control(["drone"])
    for role in ROLES:
        name = common_name(role, "drone")
        for flow, messages in (("ingress", ("put", "declare_subscriber", "query")), ("egress", ("put", "reply"))):
            for message in messages:
                assert {k.split("/")[1] for k in allowed(tree, name, flow, message)} <= {"drone"}
    assert key(VELOCITY, "drone") in allowed(tree, common_name("worker", "drone"), "ingress", "put")


def test_a_certificate_that_the_list_does_not_know_may_do_nothing() -> None:
    tree = access_control(["drone"])
    for name in ("velod-worker@other", "velod-ca", "somebody"):
        assert not any(allowed(tree, name, flow, m) for flow in ("ingress", "egress") for m in ("put", "query"))


def test_every_stream_of_the_table_is_a_workers_and_has_a_size_limit() -> None:
    for topic in TOPICS.values():
        if topic.message is not None:
            assert may_read("worker", topic)
    limits = {k: entry["size_limit"] for entry in size_limits() for k in entry["key_exprs"]}
    assert limits.keys() == {key(topic, "*") for topic in TOPICS.values()}
    assert max(limits.values()) <= MAX_BYTES


@pytest.mark.parametrize(
    ("role", "readable"),
    [("driver", []), ("consumer", [VELOCITY, ODOMETRY]), ("operator", [VELOCITY, ODOMETRY, HEALTH])],
)
def test_who_may_read_what(role: str, readable: list[Any]) -> None:
    assert [t for t in (EVENTS, FLOW, VELOCITY, ODOMETRY, HEALTH) if may_read(role, t)] == readable
    assert RIGHTS[role].is_seen is False
