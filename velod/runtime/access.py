"""Who may do what on a network that others can reach: roles, and the access-control list that enforces them.

A role is what a certificate's common name says: ``velod-worker``, or ``velod-worker@rig7`` for one rig alone. The
list denies whatever no rule allows; each rule names keys of the table of topics. It holds in the process that listens
for the network (a router, or the introducer), on its links; links within the host (TCP on loopback) are free.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from velod.wire.topics import (
    ALIVE,
    BATCH_DEPTH,
    BATCH_FLOW,
    CALIBRATION,
    CONFIG,
    EVENTS,
    HEALTH,
    IMU_SENSOR,
    ODOMETRY,
    ODOMETRY_RESET,
    PRIME,
    TOPICS,
    VELOCITY,
    VELOCITY_AGAIN,
    Topic,
    key,
)

ROLES: Final = ("driver", "worker", "consumer", "operator")
SERVER: Final = "server"
"""The certificate of the side that listens; as a router's, it is also what the next router sees of it."""

LOOPBACK_INTERFACES: Final = ("lo", "lo0")
_SENSOR = (EVENTS, IMU_SENSOR)
_PRODUCTS = (VELOCITY, VELOCITY_AGAIN, ODOMETRY)
_QUERIES = (CONFIG, CALIBRATION, ODOMETRY_RESET)
_ANSWERS = (ALIVE, *_QUERIES)
_STREAMS = tuple(topic for topic in TOPICS.values() if topic not in _ANSWERS)
# A driver reports its health, under no other name than one of a driver.
_DRIVER_HEALTH = ("velod/{rig}/health/driver-$*", "velod/{rig}/health/player-$*")

_MIB = 1 << 20
_LARGEST: dict[str, int] = {EVENTS.name: 8 * _MIB, BATCH_DEPTH.name: 16 * _MIB, BATCH_FLOW.name: 4 * _MIB}
_LARGEST_OTHER = _MIB
"""Bytes of one message from the network, by topic. 8 MiB are 900,000 events, in one packet of a few milliseconds."""


@dataclass(frozen=True, slots=True)
class Role:
    """What the holder of a certificate may do: keys with {rig} to fill in."""

    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()  # queries
    answers: tuple[str, ...] = ()
    is_seen: bool = False  # holds liveliness tokens
    sees: bool = False  # watches the tokens of others


def _keys(topics: Iterable[Topic]) -> tuple[str, ...]:
    return tuple(key(topic, "{rig}") for topic in topics)


RIGHTS: Final[dict[str, Role]] = {
    "driver": Role(publishes=(*_keys((*_SENSOR, PRIME)), *_DRIVER_HEALTH), sees=True),
    "worker": Role(
        publishes=_keys(topic for topic in _STREAMS if topic not in _SENSOR),
        subscribes=_keys(_STREAMS),
        asks=_keys(_QUERIES),
        answers=_keys(_QUERIES),
        is_seen=True,
        sees=True,
    ),
    "consumer": Role(subscribes=_keys(_PRODUCTS)),
    "operator": Role(subscribes=_keys((*_PRODUCTS, HEALTH)), asks=_keys(_QUERIES), sees=True),
}


def may_read(role: str, topic: Topic) -> bool:
    """Whether a role may subscribe to a topic."""
    return key(topic, "{rig}") in RIGHTS[role].subscribes


def common_name(role: str, rig: str = "") -> str:
    """Of the certificate of a role, for one rig or (empty) for all."""
    return f"velod-{role}@{rig}" if rig else f"velod-{role}"


def access_control(rigs: Sequence[str] = (), rights_of: Mapping[str, Role] = RIGHTS) -> dict[str, Any]:
    """Zenoh's ``access_control``: each role its rights, certificates of ``rigs`` theirs for their own rig alone."""
    rules: list[dict[str, Any]] = [_rule("local", ("ingress", "egress"), _ALL_MESSAGES, ("**",))]
    subjects: list[dict[str, Any]] = [
        {"id": "local", "interfaces": list(LOOPBACK_INTERFACES), "link_protocols": ["tcp"]}
    ]
    policies: list[dict[str, Any]] = [{"rules": ["local"], "subjects": ["local"]}]
    for rig in ("", *rigs):
        for role, rights in rights_of.items():
            name = common_name(role, rig)
            granted = _rules(name, rights, rig or "*")
            rules += granted
            # A router that was connected to is an operator here: it takes in what is for people, and sends nothing.
            holders = [name, common_name(SERVER)] if (role, rig) == ("operator", "") else [name]
            subjects.append({"id": name, "cert_common_names": holders})
            policies.append({"rules": [rule["id"] for rule in granted], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def size_limits() -> list[dict[str, Any]]:
    """Zenoh's ``low_pass_filter``: larger messages from the network are dropped before they are handed on."""
    by_limit: dict[int, list[str]] = {}
    for topic in TOPICS.values():
        by_limit.setdefault(_LARGEST.get(topic.name, _LARGEST_OTHER), []).append(key(topic, "*"))
    return [
        {
            "id": f"at-most-{limit}",
            "link_protocols": ["tls", "quic"],
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": keys,
            "size_limit": limit,
        }
        for limit, keys in sorted(by_limit.items())
    ]


_SUBSCRIBE, _QUERYABLE = "declare_subscriber", "declare_queryable"
_TOKEN, _WATCH = "liveliness_token", ("liveliness_query", "declare_liveliness_subscriber")
_ALL_MESSAGES = ("put", "delete", "query", "reply", _SUBSCRIBE, _QUERYABLE, _TOKEN, *_WATCH)


def _rules(name: str, rights: Role, rig: str) -> list[dict[str, Any]]:
    """The rules of one role. Ingress is what its holder sends, egress what it is sent."""
    alive = (key(ALIVE, "{rig}"),)
    wanted: tuple[tuple[str, str, tuple[str, ...], tuple[str, ...]], ...] = (
        ("publish", "ingress", ("put",), rights.publishes),
        ("be-heard", "egress", (_SUBSCRIBE,), rights.publishes),
        ("subscribe", "ingress", (_SUBSCRIBE,), rights.subscribes),
        ("hear", "egress", ("put",), rights.subscribes),
        ("ask", "ingress", ("query",), rights.asks),
        ("be-answered", "egress", ("reply", _QUERYABLE), rights.asks),
        ("serve", "ingress", ("reply", _QUERYABLE), rights.answers),
        ("be-asked", "egress", ("query",), rights.answers),
        ("live", "ingress", (_TOKEN,), alive if rights.is_seen else ()),
        ("be-watched", "egress", _WATCH, alive if rights.is_seen else ()),
        ("watch", "ingress", _WATCH, alive if rights.sees else ()),
        ("see", "egress", (_TOKEN,), alive if rights.sees else ()),
    )
    # Who asks or subscribes may mean many rigs at once, velod/*/velocity: a rig must get to know it all the same.
    asked = {"be-heard", "be-asked", "be-watched"}
    return [
        _rule(f"{name}-{what}", (flow,), messages, tuple(k.format(rig="*" if what in asked else rig) for k in keys))
        for what, flow, messages, keys in wanted
        if keys
    ]


def _rule(name: str, flows: Sequence[str], messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(keys),
    }
