"""Rotations, cameras, Eq. 1, distortion and rectification, calibration."""
