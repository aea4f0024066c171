"""How the simulator's kernels are compiled."""

SAME_BITS = {"nnan", "ninf", "nsz"}
"""Floating-point freedom that rounds nothing differently.

A process that compiles holds copies of a kernel that one which loads the cache does not, optimised more or less far;
with freedom to reorder or contract (``fastmath=True``) they differ in the last bit, and so would two recordings.
"""
