"""The velocity of another frame than the IMU's: w x r, and the covariance that the gyroscope adds."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import CALIBRATION, FLIGHT, messages
from velod.config import ConfigError, from_tree
from velod.geometry.calibration import Calibration, CalibrationError
from velod.geometry.so3 import exp
from velod.optimizer.frame import Rate, output_frame
from velod.optimizer.stage import OptimizerStage
from velod.types import Odometry, Velocity

T_IMU_BASE = np.eye(4)
T_IMU_BASE[:3, :3], T_IMU_BASE[:3, 3] = exp(np.array([0.3, -0.5, 1.0])), [0.4, -0.3, 0.2]
T_CAM_IMU = np.eye(4)
T_CAM_IMU[:3, :3], T_CAM_IMU[:3, 3] = exp(np.array([0.1, 0.2, -0.1])), [0.05, -0.02, 0.03]
RIG = replace(CALIBRATION, frames={"base_link": T_IMU_BASE})


def run(frame, seed=0):
    stage = OptimizerStage(from_tree({"optimizer": {"frame": frame}}), RIG)
    return [v for m in messages(FLIGHT, 1.2, seed=seed) for v in stage.handle(m)]


def test_the_velocity_of_a_lever_arm_is_that_of_its_end_and_its_covariance_is_honest():
    R_FB, p = T_IMU_BASE[:3, :3].T, T_IMU_BASE[:3, 3]
    nees = []
    for seed in range(3):
        for v in run("base_link", seed):
            if isinstance(v, Velocity) and v.valid:
                assert v.frame == "base_link"
                t = v.t_ns * 1e-9
                d = v.v_B - R_FB @ (FLIGHT.v_B(t) + np.cross(FLIGHT.w_B, p))
                nees.append(d @ np.linalg.solve(v.cov, d))
    # 3 degrees of freedom; noise that flows do not share makes the information shared_error times too small
    assert len(nees) > 200
    assert 0.3 < np.mean(nees) < 6.0


def test_up_and_odometry_are_of_the_frame_too():
    out = run("base_link")
    imu = run("imu")
    R_FB = T_IMU_BASE[:3, :3].T
    velocities, of_imu = ([v for v in o if isinstance(v, Velocity)] for o in (out, imu))
    assert np.allclose(velocities[-1].up_B, R_FB @ of_imu[-1].up_B, atol=1e-12)
    assert np.allclose(velocities[-1].up_cov, R_FB @ of_imu[-1].up_cov @ R_FB.T, atol=1e-15)
    tracks = [[o for o in outputs if isinstance(o, Odometry)] for outputs in (out, imu)]
    # the end of the lever arm moves otherwise by no more than the arm turns: twice its length
    assert abs(np.linalg.norm(tracks[0][-1].p_OB) - np.linalg.norm(tracks[1][-1].p_OB)) < 2.0 * 0.54


def test_the_camera_is_a_frame_by_the_calibration():
    frame = output_frame("camera", replace(CALIBRATION, T_cam_imu=T_CAM_IMU))
    p_B = np.array([0.3, 1.0, -0.2])
    in_camera = T_CAM_IMU[:3, :3] @ p_B + T_CAM_IMU[:3, 3]
    assert np.allclose(frame.R_FB @ (p_B - frame.p_BF_B), in_camera, atol=1e-12)


def test_the_jacobian_to_the_bias_and_to_noise_is_central_differences():
    frame, h = output_frame("base_link", RIG), 1e-6
    w, zero, v = np.array([1.0, -2.0, 0.5]), np.zeros((3, 3)), np.array([2.0, 1.0, 0.3])

    def moved(rate):
        return frame.velocity(v, zero, Rate(rate, zero, zero, zero))[0]

    # d v_F / d b_w, with w = w_measured - b_w
    J = np.stack([(moved(w - h * e) - moved(w + h * e)) / (2 * h) for e in np.eye(3)], axis=1)
    S = np.diag([1e-4, 4e-4, 9e-4])
    _, cov = frame.velocity(v, zero, Rate(w, zero, S, zero))
    assert np.allclose(cov, J @ S @ J.T, atol=1e-10)
    # jointly with v_B: [R, J] cov [R, J]^T
    A = np.random.default_rng(0).normal(size=(6, 6)) * 0.01
    joint = A @ A.T
    _, cov = frame.velocity(v, joint[:3, :3], Rate(w, zero, joint[3:, 3:], joint[:3, 3:]))
    full = np.hstack([frame.R_FB, J])
    assert np.allclose(cov, full @ joint @ full.T, atol=1e-10)


def test_a_frame_that_nobody_knows_is_refused_with_those_that_are_known():
    with pytest.raises(ConfigError, match="'base'; known: imu, camera, base_link"):
        OptimizerStage(from_tree({"optimizer": {"frame": "base"}}), RIG)


def test_frames_are_kept_by_the_calibration_and_checked():
    again = Calibration.from_tree(RIG.to_tree(), "here")
    assert np.allclose(again.frames["base_link"], T_IMU_BASE, atol=1e-12)
    assert Calibration.from_tree(CALIBRATION.to_tree(), "here").frames == {}
    tree = RIG.to_tree()
    tree["frames"]["base_link"][0][0] = 2.0
    with pytest.raises(CalibrationError, match="frames: base_link"):
        Calibration.from_tree(tree, "here")
