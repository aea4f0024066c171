"""What the commands write: velocities as CSV, results as JSON."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from velod.cli.words import up_sigma
from velod.types import Velocity

CSV_COLUMNS = (
    *("t_ns", "vx", "vy", "vz"),
    *("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("state", "valid", "age_ms"),
    *("bridged_ms", "up_x", "up_y", "up_z", "up_sigma", "frame", "degenerate"),
)
"""Velocity in m/s in B, covariance in (m/s)^2, up in B with the larger sigma of its direction in rad; age_ms: from
sensor time to publication; bridged_ms: how far the IMU carried the newest measurement."""
_UPPER = np.triu_indices(3)


def write_csv(path: str, velocities: Sequence[Velocity]) -> None:
    """One line per velocity; numbers that read back exactly; what is not known is empty."""
    with _written(path) as f:
        writer = csv.writer(f)
        writer.writerow(CSV_COLUMNS)
        for v in velocities:
            bridged_ms = math.nan if v.batch_seq < 0 else (v.t_ns - v.batch_t_ns) / 1e6
            further = [_number(a) for a in (v.age_ms, bridged_ms, *v.up_B, up_sigma(v))]
            numbers = [repr(float(a)) for a in (*v.v_B, *v.cov[_UPPER])]
            writer.writerow([v.t_ns, *numbers, v.state, int(v.valid), *further, v.frame, v.degenerate])


def write_json(path: str, value: Any) -> None:
    """JSON into a file, or onto stdout for ``-``. NaN is refused: the caller writes null."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    if path == "-":
        sys.stdout.write(text)
    else:
        with _written(path) as f:
            f.write(text)


@contextmanager
def _written(path: str) -> Iterator[TextIO]:
    """A text file to write; what fails while it is written, such as a full disk, names it too. Raises OSError."""
    try:
        with Path(path).open("w", newline="", encoding="utf-8") as f:
            yield f
    except OSError as e:
        raise OSError(e.errno, e.strerror, path) from None


def _number(a: float) -> str:
    return repr(float(a)) if math.isfinite(a) else ""
