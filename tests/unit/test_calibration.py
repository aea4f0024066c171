"""Calibration files: what is good comes back unchanged, what is bad gives one line naming file, field and reason."""

import copy
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from velod.geometry import so3
from velod.geometry.calibration import Calibration, CalibrationError, Camera
from velod.geometry.calibration_files import load_calibration, save_calibration

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "calib"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no calibrations in ../shared/data/calib")
KALIBR = DATA / "hku_esvio_davis346_stereo" / "stereo_calibra2-camchain.yaml"
KALIBR_IMU = DATA / "hku_esvio_davis346_stereo" / "2022-08-15-15-56-54-camchain-imucam.yaml"

T_CAM_IMU = np.eye(4)
T_CAM_IMU[:3, :3] = so3.exp([0.01, -0.02, 0.03])
T_CAM_IMU[:3, 3] = [0.01, 0.02, -0.06]
GOOD = Calibration(
    Camera(346, 260, 249.7, 248.4, 176.7, 129.5, "radtan", (-0.379, 0.154, 0.00114, -0.0019, 0.0)),
    Camera(346, 260, 226.4, 226.2, 173.6, 133.7, "equi", (-0.048, 0.0113, -0.0554, 0.0215)),
    so3.exp([0.002, -0.003, 0.001]),
    np.array([-0.0597, -0.0005, 0.0006]),
    T_CAM_IMU,
    0.0019,
)


def test_velods_own_file_reads_back_the_same_numbers(tmp_path: Path) -> None:
    save_calibration(tmp_path / "rig.yaml", GOOD)
    assert load_calibration(tmp_path / "rig.yaml").to_tree() == GOOD.to_tree()


def test_what_may_be_left_out_has_the_defaults_of_a_plain_rectified_pair() -> None:
    camera = {"width": 346, "height": 260, "fx": 231.5, "fy": 231.5, "cx": 172.3, "cy": 130.8}
    tree = {"left": camera, "right": camera, "R_RL": np.eye(3).tolist(), "t_RL": [-0.12, 0.0, 0.0]}
    calib = Calibration.from_tree(tree, "pair")
    assert calib.left.model == "none"
    np.testing.assert_array_equal(calib.T_cam_imu, np.eye(4))
    assert calib.time_offset_s == 0.0


BAD: list[tuple[str, Any, str]] = [
    ("left.width", 0, "left.width: must be 16 to 16384 px, got 0"),
    ("left.height", 260.5, "left.height: must be an integer"),
    ("left.fx", -249.7, "left.fx: focal length must be positive"),
    ("right.fy", 0.0, "right.fy: focal length must be positive"),
    ("right.fy", 900.0, "right.fy: pixels must be nearly square"),
    ("left.cx", 1000.0, "left.cx: principal point outside the image, got 1000 of 346 px"),
    ("right.cy", -3.0, "right.cy: principal point outside the image"),
    ("left.fx", float("nan"), "left.fx: must be a finite number"),
    ("left.fx", "249", "left.fx: must be a finite number, got '249'"),
    ("left.model", "fov", "left.model: must be one of none, radtan, equi, got 'fov'"),
    ("left.dist", [0.1, 0.2], "left.dist: radtan takes 4 or 5 numbers, got 2"),
    ("right.dist", [0.1, 0.2, 0.3, 0.4, 0.5], "right.dist: equi takes 4 numbers, got 5"),
    ("right.dist", [0.1, 0.2, float("inf"), 0.4], "right.dist: must be a finite number"),
    ("left.k1", 0.1, "left: k1: unknown"),
    ("R_RL", (2.0 * np.eye(3)).tolist(), "R_RL: rotation is not orthonormal"),
    ("R_RL", np.diag([1.0, 1.0, -1.0]).tolist(), "R_RL: rotation is a reflection (determinant -1)"),
    ("R_RL", [[1.0, 0.0], [0.0, 1.0]], "R_RL: must be 3x3 numbers, got 2x2"),
    ("t_RL", [0.06, 0.0, 0.0], "t_RL: x must be negative"),
    ("t_RL", [0.0, 0.0, 0.0], "t_RL: x must be negative"),
    ("t_RL", [-0.01, 0.1, 0.0], "t_RL: the cameras must lie side by side along x"),
    ("t_RL", [-0.06, float("nan"), 0.0], "t_RL: must be finite numbers"),
    ("t_RL", [-0.06, "a", 0.0], "t_RL: must be 3 numbers"),
    ("T_cam_imu", np.eye(3).tolist(), "T_cam_imu: must be 4x4 numbers, got 3x3"),
    ("T_cam_imu", (2.0 * np.eye(4)).tolist(), "T_cam_imu: last row must be 0 0 0 1"),
    ("T_cam_imu", np.diag([1.0, 1.0, 0.5, 1.0]).tolist(), "T_cam_imu: rotation is not orthonormal"),
    ("time_offset_s", 5.0, "time_offset_s: must be within 1 s of zero"),
    ("baseline", 0.1, "baseline: unknown"),
    ("left", 3, "left: must hold named values, got 3"),
]


@pytest.mark.parametrize(("key", "value", "reason"), BAD, ids=[f"{k} {v}"[:40] for k, v, _ in BAD])
def test_a_bad_calibration_is_refused_in_one_line_with_file_field_and_reason(
    tmp_path: Path, key: str, value: Any, reason: str
) -> None:
    tree = copy.deepcopy(GOOD.to_tree())
    at = tree
    *sections, last = key.split(".")
    for section in sections:
        at = at[section]
    at[last] = value
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(tree))
    with pytest.raises(CalibrationError) as error:
        load_calibration(path)
    assert str(error.value).startswith(f"{path}: ")
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["left", "right", "R_RL", "t_RL", "left.fx", "right.width"])
def test_a_missing_value_is_named(key: str) -> None:
    tree = copy.deepcopy(GOOD.to_tree())
    *sections, last = key.split(".")
    del (tree[sections[0]] if sections else tree)[last]
    with pytest.raises(CalibrationError, match=f"^rig: .*{last}: missing"):
        Calibration.from_tree(tree, "rig")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("left: [1, 2", "not plain YAML"),
        ("[1, 2]", "must hold named values, got list"),
        ("K: 3", "not a stereo calibration"),
        ("", "must hold named values, got NoneType"),
    ],
)
def test_a_file_that_is_no_calibration_says_why(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError) as error:
        load_calibration(path)
    assert str(error.value).startswith(f"{path}: {reason}")
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=re.escape("rig.yaml: no such file")):
        load_calibration(tmp_path / "rig.yaml")


def kalibr_tree() -> dict[str, Any]:
    def camera(c: Camera, model: str) -> dict[str, Any]:
        return {
            "camera_model": "pinhole",
            "intrinsics": [c.fx, c.fy, c.cx, c.cy],
            "resolution": [c.width, c.height],
            "distortion_model": model,
            "distortion_coeffs": list(c.dist),
        }

    T_RL = np.eye(4)
    T_RL[:3, :3], T_RL[:3, 3] = GOOD.R_RL, GOOD.t_RL
    return {
        "cam0": camera(GOOD.left, "radtan") | {"T_cam_imu": GOOD.T_cam_imu.tolist(), "timeshift_cam_imu": 0.0019},
        "cam1": camera(GOOD.right, "equidistant") | {"T_cn_cnm1": T_RL.tolist()},
    }


def test_a_kalibr_camchain_gives_the_same_rig(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(kalibr_tree()))
    assert load_calibration(path).to_tree() == GOOD.to_tree()


def test_a_kalibr_camchain_of_another_camera_model_is_refused(tmp_path: Path) -> None:
    tree = kalibr_tree()
    tree["cam1"]["camera_model"] = "omni"
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(tree))
    with pytest.raises(CalibrationError, match=re.escape("cam1.camera_model: must be pinhole, got 'omni'")):
        load_calibration(path)


def ros_tree(c: Camera, T_RL: np.ndarray, b_P: float) -> dict[str, Any]:
    def matrix(M: np.ndarray) -> dict[str, Any]:
        return {"rows": M.shape[0], "cols": M.shape[1], "data": M.ravel().tolist()}

    K = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1.0]])
    P = np.array([[200.0, 0, 170, -200.0 * b_P], [0, 200.0, 130, 0], [0, 0, 1.0, 0]])
    return {
        "image_width": c.width,
        "image_height": c.height,
        "camera_matrix": matrix(K),
        "distortion_model": {"radtan": "plumb_bob", "equi": "equidistant"}[c.model],
        "distortion_coefficients": matrix(np.array([c.dist])),
        "projection_matrix": matrix(P),
        "T_right_left": matrix(T_RL),
        "T_b_c": matrix(np.linalg.inv(GOOD.T_cam_imu)[:3]),
    }


@pytest.fixture
def ros_pair(tmp_path: Path) -> dict[str, dict[str, Any]]:
    T_RL = np.column_stack([GOOD.R_RL, GOOD.t_RL])
    b = float(np.linalg.norm(GOOD.t_RL))
    return {"left": ros_tree(GOOD.left, T_RL, 0.0), "right": ros_tree(GOOD.right, T_RL, b)}


def write_pair(directory: Path, pair: dict[str, dict[str, Any]]) -> Path:
    for side, tree in pair.items():
        (directory / f"{side}.yaml").write_text(yaml.safe_dump(tree))
    return directory


def test_a_ros_pair_gives_the_same_rig_by_directory_and_by_either_file(
    tmp_path: Path, ros_pair: dict[str, dict[str, Any]]
) -> None:
    write_pair(tmp_path, ros_pair)
    for path in (tmp_path, tmp_path / "left.yaml", tmp_path / "right.yaml"):
        calib = load_calibration(path)
        assert (calib.left, calib.right) == (GOOD.left, GOOD.right)
        np.testing.assert_allclose(calib.t_RL, GOOD.t_RL)
        np.testing.assert_allclose(calib.T_cam_imu, GOOD.T_cam_imu, atol=1e-12)


def test_a_folder_that_holds_no_ros_pair_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=f"^{tmp_path}: a folder without the left.yaml of a ROS pair$"):
        load_calibration(tmp_path)


def test_a_ros_matrix_with_fewer_numbers_than_declared_is_refused(
    tmp_path: Path, ros_pair: dict[str, dict[str, Any]]
) -> None:
    ros_pair["right"]["T_right_left"]["data"] = ros_pair["right"]["T_right_left"]["data"][:9]
    with pytest.raises(
        CalibrationError, match=re.escape("right.yaml: T_right_left: declared 3x4, but data holds 9 numbers")
    ):
        load_calibration(write_pair(tmp_path, ros_pair))


def test_two_baselines_in_one_ros_pair_are_refused(tmp_path: Path, ros_pair: dict[str, dict[str, Any]]) -> None:
    ros_pair["right"]["projection_matrix"]["data"][3] *= 1.1
    with pytest.raises(
        CalibrationError, match=re.escape("baseline 0.05971 m disagrees with the projection matrix's 0.06568 m")
    ):
        load_calibration(write_pair(tmp_path, ros_pair))


def test_half_a_ros_pair_names_the_missing_file(tmp_path: Path, ros_pair: dict[str, dict[str, Any]]) -> None:
    write_pair(tmp_path, {"left": ros_pair["left"]})
    with pytest.raises(CalibrationError, match=re.escape("right.yaml: no such file")):
        load_calibration(tmp_path)


@pytest.mark.data
@needs_data
@pytest.mark.parametrize("name", ["esvo2_rpg", "esvo2_tum_desk", "esvo2_upenn_mvsec", "esvo2_vector"])
def test_real_ros_pairs_are_read(name: str) -> None:
    calib = load_calibration(DATA / name)
    baselines = {"esvo2_rpg": 0.148, "esvo2_tum_desk": 0.119, "esvo2_upenn_mvsec": 0.0999, "esvo2_vector": 0.17}
    assert np.linalg.norm(calib.t_RL) == pytest.approx(baselines[name], rel=0.01)


@pytest.mark.data
@needs_data
def test_dsecs_right_file_is_refused_for_its_nine_numbers() -> None:
    with pytest.raises(
        CalibrationError, match=re.escape("right.yaml: T_right_left: declared 3x4, but data holds 9 numbers")
    ):
        load_calibration(DATA / "esvo2_dsec" / "right.yaml")


@pytest.mark.data
@needs_data
def test_a_real_kalibr_camchain_takes_the_imu_from_a_second_file_and_says_so_without_it() -> None:
    calib = load_calibration(KALIBR, KALIBR_IMU)
    assert calib.t_RL[0] == pytest.approx(-0.05968, abs=1e-5)
    assert calib.time_offset_s == pytest.approx(1.9438e-3, abs=1e-7)
    with pytest.raises(
        CalibrationError, match=re.escape("cam0.T_cam_imu: missing; add it, or give the camchain-imucam file")
    ):
        load_calibration(KALIBR)
    with pytest.raises(CalibrationError, match="cam1: missing"):
        load_calibration(KALIBR_IMU)
