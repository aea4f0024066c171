"""Simulated sensors: sequences of Table I as events of a stereo pair, IMU and truth (ESIM's event model)."""

from velod.sim.driver import simulated_recording
from velod.sim.run import simulate
from velod.sim.sequences import TABLE_I, Sequence, SequenceError, sequence

__all__ = ["TABLE_I", "Sequence", "SequenceError", "sequence", "simulate", "simulated_recording"]
