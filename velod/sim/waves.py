"""Sums of sines under multiplication and integration: motions that start and stop, and stay analytic.

A sum is ``((a, w, phase), ...)`` for the sum of a sin(w t + phase), w in rad/s; a constant is a wave with w = 0.
"""

from __future__ import annotations

import cmath
import math

from velod.sim.trajectory import Harmonics, Wave

Waves = tuple[Wave, ...]

_SAME_W = 1e-9


def constant(value: float) -> Waves:
    """``value`` at all times."""
    return ((value, 0.0, 0.5 * math.pi),)


def scaled(factor: float, waves: Waves) -> Waves:
    """``factor`` times the sum."""
    return tuple((factor * a, w, phase) for a, w, phase in waves)


def product(f: Waves, g: Waves) -> Waves:
    """f(t) g(t), by 2 sin A sin B = cos(A - B) - cos(A + B)."""
    parts = []
    for a, wa, pa in f:
        for b, wb, pb in g:
            half = 0.5 * a * b
            parts.append((half, wa - wb, pa - pb + 0.5 * math.pi))
            parts.append((-half, wa + wb, pa + pb + 0.5 * math.pi))
    return _merged(tuple(parts))


def power(wave: Wave, n: int) -> Waves:
    """A wave to the n-th: at rest around its zeros, the longer the larger n; n odd goes back and forth."""
    result = constant(1.0)
    for _ in range(n):
        result = product(result, (wave,))
    return result


def integral(f: Waves, start: float = 0.0) -> Harmonics:
    """The integral of f, ``start`` at t = 0."""
    rate = sum(a * math.sin(phase) for a, w, phase in f if w == 0.0)
    waves = tuple((a / w, w, phase - 0.5 * math.pi) for a, w, phase in f if w != 0.0)
    return Harmonics(start - sum(a * math.sin(phase) for a, _, phase in waves), rate, waves)


def _merged(waves: Waves) -> Waves:
    """One wave for each frequency."""
    phasors: dict[float, complex] = {}
    for a, w, phase in waves:
        if w < -_SAME_W:
            a, w, phase = -a, -w, -phase
        key = next((k for k in phasors if abs(k - w) < _SAME_W), w if w > _SAME_W else 0.0)
        phasors[key] = phasors.get(key, 0j) + cmath.rect(a, phase)
    # Of a constant only its value at t = 0 counts.
    return tuple(
        (z.imag, 0.0, 0.5 * math.pi) if w == 0.0 else (abs(z), w, cmath.phase(z)) for w, z in sorted(phasors.items())
    )
