"""Settings and calibration of a rig: the supervisor serves them, every worker asks for them, here or far away."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from velod import config
from velod.config import Settings
from velod.geometry.calibration import Calibration
from velod.wire.topics import CALIBRATION, CONFIG, Topic, key

ANSWER_S = 10.0
"""How long a service may take to answer."""


class NoServiceError(OSError):
    """Nobody serves this rig's settings; the text names the rig and the endpoint."""


@contextmanager
def serve(session: zenoh.Session, settings: Settings, calibration: Calibration) -> Iterator[None]:
    """Answer queries for settings and calibration (JSON) while the context lasts."""
    rig = settings.rig.name
    trees: tuple[tuple[Topic, dict[str, Any]], ...] = (
        (CONFIG, config.to_tree(settings)),
        (CALIBRATION, calibration.to_tree()),
    )
    queryables = [_answer(session, key(topic, rig), json.dumps(tree)) for topic, tree in trees]
    try:
        yield
    finally:
        for queryable in queryables:
            queryable.undeclare()


def fetch(session: zenoh.Session, rig: str, endpoint: str) -> tuple[Settings, Calibration]:
    """Settings and calibration of the service at ``endpoint``.

    Raises NoServiceError where nobody answers, ConfigError and CalibrationError for an answer of no use.
    """
    deadline_s = time.monotonic() + ANSWER_S
    trees = []
    for topic in (CONFIG, CALIBRATION):
        while (tree := _ask(session, key(topic, rig))) is None:
            if time.monotonic() > deadline_s:
                raise NoServiceError(f"no velod serves rig {rig!r} at {endpoint}: is `velod run` up there?")
            time.sleep(0.02)
        trees.append(tree)
    source = f"{endpoint} ({rig})"
    return config.from_tree(trees[0], source), Calibration.from_tree(trees[1], source)


def _answer(session: zenoh.Session, at: str, text: str) -> Any:
    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(at, text)

    return session.declare_queryable(at, reply)


def _ask(session: zenoh.Session, at: str) -> dict[str, Any] | None:
    for reply in session.get(at, timeout=1.0):
        if reply.ok is not None:
            tree = json.loads(reply.ok.payload.to_string())
            return tree if isinstance(tree, dict) else None
    return None
