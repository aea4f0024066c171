"""Simulated sensors: sequences of Table I as events of a stereo pair, IMU and truth (ESIM's event model)."""

from velod.sim.driver import simulated_recording
from velod.sim.held_out import HELD_OUT
from velod.sim.recipe import Sequence
from velod.sim.run import simulate
from velod.sim.sequences import TABLE_I, SequenceError, all_names, sequence

__all__ = [
    "HELD_OUT",
    "TABLE_I",
    "Sequence",
    "SequenceError",
    "all_names",
    "sequence",
    "simulate",
    "simulated_recording",
]
