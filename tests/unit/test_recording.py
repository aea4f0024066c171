"""Readers: what is read, and one clear line for everything that is wrong with a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import yaml

from velod.geometry.calibration import Calibration, CalibrationError, Camera
from velod.geometry.calibration_files import save_calibration
from velod.io import (
    EventColumns,
    Imu,
    RecordingError,
    SequenceData,
    Truth,
    open_recording,
    write_recording,
)
from velod.types import EventPacket, ImuPacket


def camera(model: str = "none", dist: tuple[float, ...] = ()) -> Camera:
    return Camera(64, 48, 50.0, 50.0, 32.0, 24.0, model, dist)


def calibration(cam: Camera | None = None) -> Calibration:
    cam = cam or camera()
    return Calibration(cam, cam, np.eye(3), np.array([-0.1, 0.0, 0.0]))


def events(seed: int, n: int = 2000) -> EventColumns:
    rng = np.random.default_rng(seed)
    return EventColumns(
        np.sort(rng.integers(0, 100_000, n)) * 1000,
        rng.integers(0, 64, n).astype(np.uint16),
        rng.integers(0, 48, n).astype(np.uint16),
        rng.integers(0, 2, n).astype(np.uint8),
    )


def sequence() -> SequenceData:
    t_ns = np.arange(21, dtype=np.int64) * 5_000_000
    imu = Imu(t_ns, np.full((21, 3), 1.0), np.full((21, 3), 2.0))
    truth = Truth(t_ns, np.full((21, 3), 3.0), np.full((21, 3), 4.0), np.tile([0.0, 0.0, 0.0, 1.0], (21, 1)))
    return SequenceData(calibration(), events(1), events(2), imu, truth)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_recording(tmp_path / "sequence.h5", sequence())
    return tmp_path / "sequence.h5"


def test_a_written_sequence_reads_back_equal(path: Path) -> None:
    data, recording = sequence(), open_recording(path)
    assert recording.calibration.left == data.calibration.left
    assert recording.calibration.t_RL.tolist() == [-0.1, 0.0, 0.0]
    assert recording.n_events == 4000
    assert recording.t_end_ns == 100_000_000
    for camera_name, written in (("left", data.left), ("right", data.right)):
        got = [p for p in recording.packets() if isinstance(p, EventPacket) and p.camera == camera_name]
        for column, name in ((written.t_ns, "event_t_ns"), (written.x, "x"), (written.y, "y"), (written.p, "p")):
            assert np.array_equal(np.concatenate([getattr(p, name) for p in got]), column)
    samples = [p for p in recording.packets() if isinstance(p, ImuPacket)]
    assert np.array_equal(np.concatenate([p.sample_t_ns for p in samples]), data.imu.t_ns)
    assert recording.truth is not None
    assert recording.truth.v_B[0].tolist() == [3.0, 3.0, 3.0]


def test_equal_sequences_give_equal_bytes(path: Path, tmp_path: Path) -> None:
    write_recording(tmp_path / "again.h5", sequence())
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(("model", "dist"), [("radtan", (0.1, 0.2, 0.01, 0.02, 0.0)), ("equi", (0.1, 0.2, 0.3, 0.4))])
def test_distortion_is_kept(tmp_path: Path, model: str, dist: tuple[float, ...]) -> None:
    write_recording(tmp_path / "d.h5", replace(sequence(), calibration=calibration(camera(model, dist))))
    assert open_recording(tmp_path / "d.h5").calibration.left == camera(model, dist)


def test_a_given_calibration_replaces_the_files_own(path: Path) -> None:
    other = calibration(replace(camera(), fx=60.0, fy=60.0))
    assert open_recording(path, calibration=other).calibration is other


def test_blosc_is_read_when_the_plugin_is_there(path: Path) -> None:
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(path, "a") as file:
        x = file["events/left/x"][:]
        del file["events/left/x"]
        file.create_dataset("events/left/x", data=x, **hdf5plugin.Blosc())
    assert sum(len(p.x) for p in open_recording(path).packets() if isinstance(p, EventPacket)) == 4000


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere\.h5: no such file"):
        open_recording(tmp_path / "nowhere.h5")


def test_a_file_that_is_not_hdf5_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"events, honestly" * 100)
    with pytest.raises(RecordingError, match=r"a\.h5: not an HDF5 file$"):
        open_recording(tmp_path / "a.h5")


def test_a_file_of_another_kind_is_told_what_is_read(tmp_path: Path) -> None:
    for name, cause in (("a.raw", "neither an HDF5 file nor a folder"), ("events.txt", f"the folder {tmp_path}$")):
        (tmp_path / name).write_text("0.0 1 2 1\n")
        with pytest.raises(RecordingError, match=cause):
            open_recording(tmp_path / name)


def test_a_truncated_file_says_so(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(RecordingError, match=r"sequence\.h5: truncated HDF5 file"):
        open_recording(path)


def test_a_directory_without_a_known_layout_says_so(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="not a recording"):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["events/left/x", "events/right/t", "imu/gyro", "gt/v_B"])
def test_a_missing_dataset_is_named(path: Path, name: str) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
    with pytest.raises(RecordingError, match=f"sequence.h5: dataset /{name} is missing"):
        open_recording(path)


def test_off_may_be_written_as_minus_one(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "a") as file:
        p = file["events/left/p"][:].astype(np.int8)
        del file["events/left/p"]
        file["events/left/p"] = np.where(p == 0, -1, p)
    for side in ("left", "right"):
        write_text(tmp_path / side, 1)
        (text := tmp_path / side / "events.txt").write_text(text.read_text().replace(" 0\n", " -1\n"))
    for recording in (open_recording(path), open_recording(tmp_path, calibration=calibration())):
        read = np.concatenate([block.p for block in recording.left.blocks()])
        assert np.array_equal(read, events(1).p)
        assert set(read) == {0, 1}


def test_columns_of_different_length_are_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["events/left/p"]
        file["events/left/p"] = np.ones(1999, np.uint8)
    with pytest.raises(RecordingError, match="/events/left differ in length: x 2000, y 2000, t 2000, p 1999"):
        open_recording(path)


def test_a_recording_without_an_imu_is_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["imu"]
    with pytest.raises(RecordingError, match="no IMU"):
        open_recording(path)


def test_a_recording_without_calibration_is_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["calib"]
    with pytest.raises(CalibrationError, match=r"sequence\.h5: no calibration"):
        open_recording(path)


@pytest.mark.parametrize("name", ["width", "fx", "baseline_m"])
def test_an_incomplete_calibration_names_what_is_missing(path: Path, name: str) -> None:
    with h5py.File(path, "a") as file:
        del file["calib"].attrs[name]
    with pytest.raises(CalibrationError, match=f"attribute {name} of /calib is missing"):
        open_recording(path)


@pytest.mark.parametrize(("name", "value"), [("width", 0), ("fx", -1.0), ("fy", np.nan), ("baseline_m", 0.0)])
def test_an_impossible_calibration_is_refused(path: Path, name: str, value: float) -> None:
    with h5py.File(path, "a") as file:
        file["calib"].attrs[name] = value
    with pytest.raises(CalibrationError, match=r"sequence\.h5:/calib"):
        open_recording(path)


def test_a_calibration_of_another_sensor_is_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["calib"].attrs.update({"width": 32, "cx": 16.0})
    with pytest.raises(CalibrationError, match="lie outside its 32 x 48 pixels"):
        open_recording(path)


def test_event_times_going_backwards_are_named_with_their_place(path: Path) -> None:
    with h5py.File(path, "a") as file:
        t = file["events/right/t"][:]
        t[1000] = t[999] - 7
        file["events/right/t"][...] = t
    with pytest.raises(RecordingError, match=r"sequence\.h5:/events/right: event times go backwards by 7 us"):
        list(open_recording(path).packets())


def test_imu_times_that_do_not_increase_are_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["imu/t_us"][3] = file["imu/t_us"][2]
    with pytest.raises(RecordingError, match="/imu/t_us does not increase at sample 3"):
        open_recording(path)


def test_a_counter_that_rolled_over_is_named(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["events/left/t"][...] = (file["events/left/t"][:] + 2**32 - 50_000) % 2**32
    with pytest.raises(RecordingError, match=r"/events/left: event times go backwards: .* rolled over"):
        open_recording(path)


@pytest.mark.parametrize("name", ["events/left/t", "imu/t_us"])
def test_a_time_that_leaps_is_refused_instead_of_waited_for(path: Path, name: str) -> None:
    with h5py.File(path, "r+") as file:
        file[name][-1] = 10**15
    with pytest.raises(RecordingError, match=r"21 IMU samples over 1e[+]09 s"):
        open_recording(path)


def test_imu_times_in_seconds_are_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        t_s = file["imu/t_us"][:] * 1e-6
        del file["imu/t_us"]
        file["imu/t_us"] = t_s
    with pytest.raises(RecordingError, match=r"imu/t_us spans 0\.1 us with 21 times: are they seconds"):
        open_recording(path)


def test_fractions_of_a_microsecond_are_kept(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        t_us = file["imu/t_us"][:] + 0.25
        del file["imu/t_us"]
        file["imu/t_us"] = t_us
    assert np.array_equal(open_recording(path).imu.t_ns, sequence().imu.t_ns + 250)


def test_a_damaged_block_is_not_taken_for_a_missing_filter(path: Path) -> None:
    with h5py.File(path) as file:
        chunk = file["events/left/t"].id.get_chunk_info(0)
    raw = bytearray(path.read_bytes())
    raw[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(raw)
    with pytest.raises(RecordingError, match=r"sequence\.h5: damaged"):
        open_recording(path)


def test_a_directory_in_the_place_of_the_file_is_said_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written: is a directory"):
        write_recording(tmp_path, sequence())


def test_on_a_full_disk_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = iter([1 << 30, 1 << 23])  # enough for an empty file, none for events
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=next(free)))
    with pytest.raises(RecordingError, match=r"full\.h5: cannot be written: no space left"):
        write_recording(tmp_path / "full.h5", sequence())
    assert list(tmp_path.iterdir()) == []


def test_streams_on_different_clocks_are_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["imu/t_us"][...] = file["imu/t_us"][:] + 10_000_000
    with pytest.raises(RecordingError, match="clocks differ"):
        open_recording(path)


def test_what_the_format_cannot_hold_is_not_written(tmp_path: Path) -> None:
    data = sequence()
    with pytest.raises(RecordingError, match="whole microseconds"):
        write_recording(tmp_path / "a.h5", replace(data, left=replace(data.left, t_ns=data.left.t_ns + 1)))
    turned = replace(data.calibration, t_RL=np.array([-0.1, 0.01, 0.0]))
    with pytest.raises(RecordingError, match="equal, aligned cameras"):
        write_recording(tmp_path / "a.h5", replace(data, calibration=turned))
    assert list(tmp_path.iterdir()) == []


def write_dsec(root: Path) -> None:
    for side, columns in (("left", events(1)), ("right", events(2))):
        (root / "events" / side).mkdir(parents=True)
        with h5py.File(root / "events" / side / "events.h5", "w") as file:
            for name, column in (("x", columns.x), ("y", columns.y), ("p", columns.p)):
                file[f"events/{name}"] = column
            file["events/t"] = (columns.t_ns // 1000).astype(np.uint32)
            file["t_offset"] = 50_000_000_000
            file["ms_to_idx"] = np.arange(100)
    intrinsics = {
        "camera_matrix": [50.0, 50.0, 32.0, 24.0],
        "distortion_coeffs": [0.1, 0.2, 0.01, 0.02],
        "distortion_model": "radtan",
        "resolution": [64, 48],
    }
    shift = np.eye(4)
    shift[0, 3] = -0.2
    tree = {
        "intrinsics": {"cam0": intrinsics, "cam3": intrinsics},
        "extrinsics": {"T_10": shift.tolist(), "T_21": shift.tolist(), "T_32": shift.tolist()},
    }
    (root / "cam_to_cam.yaml").write_text(yaml.safe_dump(tree))
    with h5py.File(root / "imu.h5", "w") as file:
        file["imu/t_us"] = 50_000_000_000 + np.arange(21) * 5000
        file["imu/accel"] = file["imu/gyro"] = np.ones((21, 3))


def test_dsecs_layout_is_read_with_its_offset_and_chained_extrinsics(tmp_path: Path) -> None:
    write_dsec(tmp_path)
    recording = open_recording(tmp_path)
    assert recording.left.first_t_ns == events(1).t_ns[0] + 50_000_000_000_000
    assert recording.calibration.t_RL == pytest.approx([-0.6, 0.0, 0.0])
    assert recording.calibration.left == camera("radtan", (0.1, 0.2, 0.01, 0.02, 0.0))
    packets = [p for p in recording.packets() if isinstance(p, EventPacket) and p.camera == "right"]
    assert np.array_equal(np.concatenate([p.event_t_ns for p in packets]), events(2).t_ns + 50_000_000_000_000)


def test_dsec_without_an_imu_says_that_velod_needs_one(tmp_path: Path) -> None:
    write_dsec(tmp_path)
    (tmp_path / "imu.h5").unlink()
    with pytest.raises(RecordingError, match="no IMU: velod needs one"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("intrinsics: {}", "cam0 is missing"),
        ("]", "not a DSEC calibration"),
        ("[]", "not a DSEC calibration"),
        ("intrinsics: {cam0: {distortion_model: radtan}}", "cam0: camera_matrix is missing"),
        ("intrinsics: {cam0: {distortion_model: radtan, camera_matrix: [1]}}", "camera_matrix holds 1 numbers"),
    ],
)
def test_a_broken_dsec_calibration_names_the_cause(tmp_path: Path, text: str, cause: str) -> None:
    write_dsec(tmp_path)
    (tmp_path / "cam_to_cam.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=rf"cam_to_cam\.yaml: .*{cause}"):
        open_recording(tmp_path)


def write_text(root: Path, seed: int) -> None:
    root.mkdir(exist_ok=True)
    e = events(seed)
    rows = zip(e.t_ns / 1e9, e.x, e.y, e.p, strict=True)
    (root / "events.txt").write_text("".join(f"{t:.6f} {x} {y} {p}\n" for t, x, y, p in rows))
    (root / "calib.txt").write_text("50 50 32 24 0 0 0 0 0\n")
    (root / "imu.txt").write_text("".join(f"{i * 0.005:.6f} 0 0 9.81 0.1 0.2 0.3\n" for i in range(21)))


def test_the_text_format_is_read_for_two_cameras(tmp_path: Path) -> None:
    write_text(tmp_path / "a", 1)
    write_text(tmp_path / "b", 2)
    save_calibration(tmp_path / "a" / "calibration.yaml", calibration())
    # Moving along W's x at 2 m/s and turning about z at 1 rad/s, starting with B = W.
    half = np.arange(21) * 0.005 / 2
    (tmp_path / "a" / "groundtruth.txt").write_text(
        "".join(f"{i * 0.005:.6f} {i * 0.01} 0 0 0 0 {np.sin(h)} {np.cos(h)}\n" for i, h in enumerate(half))
    )
    recording = open_recording(tmp_path / "a", right=tmp_path / "b")
    assert (recording.left.n_events, recording.right.n_events) == (2000, 2000)
    packets = [p for p in recording.packets() if isinstance(p, EventPacket) and p.camera == "right"]
    for name, column in (("event_t_ns", events(2).t_ns), ("x", events(2).x), ("y", events(2).y), ("p", events(2).p)):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in packets]), column)
    assert recording.imu.accel[0].tolist() == [0.0, 0.0, 9.81]
    assert recording.truth is not None
    assert recording.truth.omega_B[5] == pytest.approx([0.0, 0.0, 1.0])
    yaw = recording.truth.t_ns[5] / 1e9
    assert recording.truth.v_B[5] == pytest.approx([2 * np.cos(yaw), -2 * np.sin(yaw), 0.0])


def test_a_monocular_text_recording_says_that_two_cameras_are_needed(tmp_path: Path) -> None:
    write_text(tmp_path, 1)
    with pytest.raises(RecordingError, match="one camera only: velod needs two"):
        open_recording(tmp_path)


def test_a_text_recording_without_a_baseline_is_refused(tmp_path: Path) -> None:
    write_text(tmp_path / "left", 1)
    write_text(tmp_path / "right", 2)
    with pytest.raises(CalibrationError, match="no stereo calibration"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "cause"),
    [
        ("events.txt", "0.1 3 4 1\n0.2 spam 4 1\n", "not numbers"),
        ("events.txt", "0.1 3 4\n", "3 numbers a line, expected 4"),
        ("events.txt", "346 260\n0.1 3 4 1\n", "not numbers"),
        ("events.txt", "0.1 3 4 1\nnan 3 4 1\n", "not finite numbers: 'nan 3 4 1"),
        ("events.txt", "1500000000000000 3 4 1\n", "a time of 1.5e[+]15 s: are the times seconds"),
        ("events.txt", "3 4 1 0.2\n1 4 1 0.2\n", "event times go backwards: the first is 3.000 s"),
        ("imu.txt", "", "is empty"),
        ("imu.txt", "0.1 0 0 0 0 0 0\n0.1 0 0 0 0 0 0\n", "times do not increase at line 2"),
    ],
)
def test_broken_text_names_file_and_cause(tmp_path: Path, name: str, text: str, cause: str) -> None:
    for side, seed in (("left", 1), ("right", 2)):
        write_text(tmp_path / side, seed)
    (tmp_path / "left" / name).write_text(text)
    with pytest.raises(RecordingError, match=f"{name}: {cause}"):
        list(open_recording(tmp_path, calibration=calibration()).packets())


def test_blank_lines_and_comments_are_no_events(tmp_path: Path) -> None:
    for side, seed in (("left", 1), ("right", 2)):
        write_text(tmp_path / side, seed)
        for file in (tmp_path / side).iterdir():
            file.write_text(f"# t x y p\n{file.read_text()}\n\n")
    assert open_recording(tmp_path, calibration=calibration()).n_events == 4000


def test_text_in_another_encoding_is_named(tmp_path: Path) -> None:
    write_text(tmp_path / "left", 1)
    write_text(tmp_path / "right", 2)
    (tmp_path / "right" / "events.txt").write_text("0.1 3 4 1\n", encoding="utf-16")
    with pytest.raises(RecordingError, match=r"events\.txt: not plain text in UTF-8"):
        open_recording(tmp_path, calibration=calibration())


def test_text_with_times_in_microseconds_is_refused_instead_of_played_for_days(tmp_path: Path) -> None:
    for side in ("left", "right"):
        write_text(tmp_path / side, 1)
        for name in ("events.txt", "imu.txt"):
            file = tmp_path / side / name
            table = np.loadtxt(file, ndmin=2)
            table[:, 0] *= 1e6
            np.savetxt(file, table, fmt="%g")
    with pytest.raises(RecordingError, match=r"IMU samples over .*text: s"):
        open_recording(tmp_path, calibration=calibration())
