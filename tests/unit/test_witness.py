"""The witness: what the estimate has moved away from it is doubt, until they agree or it is too old."""

import numpy as np
import pytest

from velod.geometry.so3 import exp
from velod.optimizer.head import Head
from velod.optimizer.witness import LOOK_BACK_NS, OLDEST_NS, Witness

MS = 1_000_000
R_LB = exp(np.array([0.3, -0.2, 0.5]))
COV = np.eye(3) * 0.03**2


def head(t_ns, v_B=(1.0, 2.0, 3.0)):
    cov = np.zeros((12, 12))
    cov[:3, :3] = COV
    none = np.zeros(3)
    return Head(t_ns, np.array(v_B), none, none, none, R_LB, cov, none, np.zeros((3, 3)), none)


@pytest.fixture
def suspicious():
    """A witness since a disagreement at 1 s, with batches every 10 ms before."""
    witness = Witness()
    for t in range(0, 1000, 10):
        witness.watch(head(t * MS), suspicious=False)
    assert witness.head is None
    witness.watch(head(1000 * MS), suspicious=True)
    return witness


def test_the_witness_is_from_before_the_disagreement(suspicious):
    assert 0 <= suspicious.head.t_ns - (990 * MS - LOOK_BACK_NS) < 20 * MS
    before = suspicious.head
    suspicious.watch(head(1010 * MS), suspicious=True)
    assert suspicious.head is before


def test_what_noise_does_not_explain_is_told_in_L(suspicious):
    newest = head(1010 * MS)
    suspicious.compare(newest, newest.v_B - [0.0, 0.6, 0.0], COV, suspicious=True)
    assert np.allclose(R_LB.T @ suspicious.doubt_L @ R_LB, COV + np.diag([0.0, 0.36, 0.0]))
    assert "0.60 m/s" in suspicious.testimony
    suspicious.compare(newest, newest.v_B - [0.0, 0.1, 0.0], COV, suspicious=True)
    assert not suspicious.doubt_L.any() and suspicious.testimony == ""


def test_a_witness_that_agrees_when_the_disagreement_is_over_is_dismissed(suspicious):
    newest = head(1010 * MS)
    suspicious.compare(newest, newest.v_B, COV, suspicious=True)
    assert suspicious.head is not None
    suspicious.compare(newest, newest.v_B - [0.0, 0.6, 0.0], COV, suspicious=False)
    assert suspicious.head is not None
    suspicious.compare(newest, newest.v_B, COV, suspicious=False)
    assert suspicious.head is None


def test_what_is_seen_for_seconds_are_the_surroundings(suspicious):
    newest = head(1010 * MS)
    suspicious.compare(newest, newest.v_B - [0.0, 0.6, 0.0], COV, suspicious=False)
    suspicious.watch(head(suspicious.head.t_ns + OLDEST_NS + 1), suspicious=False)
    assert suspicious.head is None and suspicious.testimony == ""


def test_without_an_estimate_from_before_there_is_no_witness():
    witness = Witness()
    witness.watch(head(0), suspicious=True)
    assert witness.head is None
