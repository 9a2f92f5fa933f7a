"""The inclination log, with the faults of scanners and file transfers."""

import os

import numpy as np
import pytest

from station.errors import NotReadyError, ScanError
from station.readers.inclination import align_gps_week, read_inclination
from station.science.geometry.inclination import clean


def write_log(tmp_path, text):
    path = tmp_path / "s-incl.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_real_log(shared_data):
    log = read_inclination(shared_data / "riegl/140123_202748-incl.txt")
    assert len(log.time_s) == 10
    assert log.time_s[[0, -1]] == pytest.approx([91.8223, 100.8962])
    assert np.degrees(log.roll_rad[:3]) == pytest.approx([-0.286, -0.285, -0.288])
    assert np.degrees(log.pitch_rad[-1]) == pytest.approx(-0.277)


def test_unreadable_rows_are_kept_as_nan_in_file_order(tmp_path):
    rows = (
        "1,0.1,0.2\nbad row\n2,0.1\n2,nan,0.2\n2,0.1,0.2\n2,0.1,0.2\n1.5,0.1,0.2\n\n3,,0.2\n4,0.3,0.4,extra\n"
    )
    log = read_inclination(write_log(tmp_path, "Time,Roll,Pitch\n" + rows))
    assert log.time_s == pytest.approx([1, np.nan, np.nan, np.nan, 2, 2, 1.5, np.nan, 4], nan_ok=True)
    assert np.array_equal(np.isnan(log.roll_rad), np.isnan(log.time_s))
    assert np.degrees(log.pitch_rad[-1]) == pytest.approx(0.4)


@pytest.mark.parametrize(
    "text",
    [
        "Time,Roll,Pitch\r\n1,0.1,0.2\r\n2,0.1,0.2\r\n",
        "\ufeffTime,Roll,Pitch\n1,0.1,0.2\n2,0.1,0.2\n",
        ' time , "Roll", pitch\n1,0.1,0.2\n2,0.1,0.2\n',
        "Pitch,Time,Roll,Temp\n0.2,1,0.1,7\n0.2,2,0.1,7\n",
    ],
)
def test_header_variants(tmp_path, text):
    log = read_inclination(write_log(tmp_path, text))
    assert list(log.time_s) == [1, 2]
    assert np.degrees(log.pitch_rad) == pytest.approx([0.2, 0.2])
    assert np.degrees(log.roll_rad) == pytest.approx([0.1, 0.1])


def test_time_of_another_day_is_unreadable(tmp_path):
    rows = [f"{second},0.1,0.2" for second in range(40, 60)]
    rows[7], rows[19] = "9e17,0.1,0.2", "-90000,0.1,0.2"
    (tmp_path / "s-incl.txt").write_text("\n".join(["Time,Roll,Pitch", *rows, ""]))
    log = read_inclination(tmp_path / "s-incl.txt")
    assert np.flatnonzero(np.isnan(log.time_s)).tolist() == [7, 19]
    assert np.isnan(log.roll_rad[7])
    assert log.time_s[-2] == 58


def test_incomplete_last_line_is_unreadable(tmp_path):
    log = read_inclination(write_log(tmp_path, "Time,Roll,Pitch\n1,0.1,-0.275\n2,0.1,-0.2"))
    assert log.time_s == pytest.approx([1, np.nan], nan_ok=True)


def test_week_seconds_continue_past_the_end_of_the_week(tmp_path):
    log = read_inclination(write_log(tmp_path, "Time,Roll,Pitch\n604799.5,0,0\n0.5,0,0\n1.5,0,0\n"))
    assert list(log.time_s) == [604_799.5, 604_800.5, 604_801.5]


@pytest.mark.parametrize("row", [0, 300, 899, 1799])
@pytest.mark.parametrize("start_s", [518_500.0, 603_900.0, 3_000.0])
@pytest.mark.parametrize("wrong_s", [0.0, 604_000.5])
def test_a_wrong_time_costs_one_row_at_any_time_of_the_week(tmp_path, row, start_s, wrong_s):
    """On Saturdays zero could be the end of the GPS week; on Sundays the end of the week is garbage."""
    time_s = (start_s + np.arange(1800)) % 604_800
    expected = np.delete(start_s + np.arange(1800), row) % 604_800
    time_s[row] = wrong_s
    rows = [f"{second:.4f},0.1,0.2" for second in time_s]
    log = read_inclination(write_log(tmp_path, "\n".join(["Time,Roll,Pitch", *rows, ""])))
    cleaned, _ = clean(log, np.radians(10.0))
    assert len(cleaned.time_s) >= 1799  # a wrong time that fits by chance is kept
    scan_s = start_s + 900
    aligned = align_gps_week(cleaned, scan_s)
    assert np.isin(expected, aligned.time_s % 604_800).all()
    assert 0 <= np.ptp(aligned.time_s) < 1801
    assert abs(np.median(aligned.time_s) - scan_s) < 10


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "contains no rows"),
        ("\n\n", "contains no rows"),
        ("Time,Roll,Pitch\n", "none of 0 rows"),
        ("Time,Roll,Pitch\nx,y,z\n", "none of 1 rows"),
        ("Time,X,Y\n1,2,3,4\n", "is not Time,Roll,Pitch but 'Time,X,Y'"),
        ("1,2,3,4\n", "is not Time,Roll,Pitch"),
        (bytes(range(256)) * 10, "is not Time,Roll,Pitch"),
        (b"\0" * 1000, "contains no rows"),
    ],
)
def test_log_without_readable_rows_is_rejected(tmp_path, text, reason):
    with pytest.raises(ScanError, match=reason):
        read_inclination(write_log(tmp_path, text))


def test_oversized_log_is_rejected(tmp_path):
    path = tmp_path / "s-incl.txt"
    with path.open("wb") as file:
        os.truncate(file.fileno(), 1 << 34)
    with pytest.raises(ScanError, match="too large"):
        read_inclination(path)


def test_missing_log_is_not_ready(tmp_path):
    with pytest.raises(NotReadyError, match="No such file"):
        read_inclination(tmp_path / "none-incl.txt")


@pytest.mark.parametrize(
    "text",
    [
        "Time;Roll;Pitch\n40,5;-0,286;0,275\n41,5;-0,285;0,265\n",
        "Time[s]\tRoll[deg]\tPitch[deg]\r\n40.5\t-0.286\t0.275\r\n41.5\t-0.285\t0.265\r\n",
        "40.5,-0.286,0.275\n41.5,-0.285,0.265\n",
        "40.5 -0.286 0.275\n41.5 -0.285 0.265\n",
        "Pitch (mrad),Roll (mrad),Time (ms)\n4.799655,-4.991642,40500\n4.625123,-4.974188,41500\n",
    ],
)
def test_logs_in_other_dialects(tmp_path, text):
    """0.275° are 4.799655 mrad."""
    path = tmp_path / "a-incl.txt"
    path.write_text(text)
    log = read_inclination(path)
    assert log.time_s == pytest.approx([40.5, 41.5])
    assert np.degrees(log.roll_rad) == pytest.approx([-0.286, -0.285], abs=1e-6)
    assert np.degrees(log.pitch_rad) == pytest.approx([0.275, 0.265], abs=1e-6)
