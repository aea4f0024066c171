"""The calibration as the data see it: values for health, and alarms where they contradict it."""

from __future__ import annotations

import math

from velod.alarms import Alarms
from velod.config import ImuSettings, OptimizerSettings
from velod.optimizer.depth_share import DepthShare
from velod.optimizer.rotation_check import Offsets
from velod.optimizer.scale_check import ScaleCheck
from velod.optimizer.stereo_check import StereoCheck
from velod.types import F64, DepthBatch, FlowBatch

EVERY = 4
"""Of so many batches one is looked at for the cameras; the velocities are all."""
SURE = 3.0
"""An alarm is raised when a value is beyond its limit by this many sigmas."""

CLOCK, ROWS, SCALE = "calibration.clock", "calibration.rows", "calibration.scale"
MATCHES = "calibration.matches"
IMU_CLOCK, IMU_ROTATION = "calibration.imu_clock", "calibration.imu_rotation"


class CalibrationCheck:
    """``gauges`` and ``alarms`` are kept up to date; a value that the motion does not show is missing."""

    def __init__(self, settings: OptimizerSettings, imu: ImuSettings, camera: tuple[float, float, float]) -> None:
        """``camera``: f, cx, cy of the rectified left image, px."""
        self.gauges: dict[str, float] = {}
        self.alarms = Alarms()
        self._limits = {
            CLOCK: settings.alarm_clock_ms,
            ROWS: settings.alarm_rows_px,
            SCALE: settings.alarm_scale_percent,
            IMU_CLOCK: settings.alarm_imu_clock_ms,
            IMU_ROTATION: settings.alarm_imu_rotation_deg,
        }
        self._stereo, self._scale, self._depths = StereoCheck(camera), ScaleCheck(imu), DepthShare()
        self._offsets: Offsets | None = None
        self._turn = 0

    def add_batch(self, flow: FlowBatch, depth: DepthBatch) -> None:
        """Flow and depth of one batch."""
        self._depths.add(depth)
        self.gauges[f"{MATCHES}_percent"] = 100.0 * self._depths.mean
        self.alarms.say(MATCHES, self._depths.alarm)
        self._turn += 1
        if self._turn % EVERY:
            return
        self._stereo.add(flow, depth)
        if self._turn % (EVERY * EVERY) or (offsets := self._stereo.offsets()) is None:
            return
        clock = (1e3 * offsets.clock_s, 1e3 * offsets.clock_sigma_s)
        self._judge(CLOCK, "ms", clock, "the right camera's clock is {:+.2f} +- {:.2f} ms late")
        rows = (offsets.row_px, offsets.row_sigma_px)
        self._judge(ROWS, "px", rows, "the right image lies {:+.2f} +- {:.2f} px low")

    def add_solution(self, t_ns: int, s_L: F64, e: F64) -> None:
        """A batch's own solution ``e`` (3,) for the error of ``s_L`` (3,), m/s, at its end."""
        self._scale.add(t_ns, s_L, e)
        if (scale := self._scale.scale()) is not None:
            percent = (100.0 * scale.error, 100.0 * scale.sigma)
            self._judge(
                SCALE, "percent", percent, "the cameras' scale is {:+.2f} +- {:.2f} % off the IMU's: baseline?"
            )

    def use_noise(self, imu: ImuSettings) -> None:
        """The IMU's noise as it shows by now."""
        self._scale.imu = imu

    def add_offsets(self, offsets: Offsets) -> None:
        """The newest of the events against the IMU; the same again says nothing new."""
        if offsets is self._offsets:
            return
        self._offsets = offsets
        clock = (1e3 * offsets.delay_s, 1e3 * offsets.delay_sigma_s)
        self._judge(IMU_CLOCK, "ms", clock, "the events are {:+.2f} +- {:.2f} ms late against the IMU")
        turned, sigma, axis_B = offsets.worst_turn
        axis = "[{:+.2f} {:+.2f} {:+.2f}]".format(*axis_B)
        text = "the camera is turned by {:+.2f} +- {:.2f} degrees about " + axis + " of the IMU: T_cam_imu?"
        self._judge(IMU_ROTATION, "deg", (math.degrees(turned), math.degrees(sigma)), text)

    def _judge(self, name: str, unit: str, value_and_sigma: tuple[float, float], text: str) -> None:
        value, sigma = value_and_sigma
        names = (f"{name}_{unit}", f"{name}_sigma_{unit}")
        wrong = bool(self._limits[name]) and abs(value) - SURE * sigma > self._limits[name]
        self.alarms.say(name, text.format(value, sigma) if wrong else "")
        if math.isfinite(sigma):
            self.gauges.update(zip(names, value_and_sigma, strict=True))
        else:
            for gauge in names:
                self.gauges.pop(gauge, None)
