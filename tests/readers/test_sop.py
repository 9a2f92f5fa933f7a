"""SOP and POP matrices in files, and the SOP valid at a time."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.errors import ConfigError, ScanError
from station.readers.sop import read_matrix, valid_sop
from station.sections.inputs import SopSection

ROTATION = Rotation.from_euler("xyz", [0.1, 0.59, -1.2]).as_matrix()


def write_matrix(tmp_path, rotation, *, last="0 0 0 1", head="# solved from 241001_120000\n", digits=16):
    rows = [f"{a:.{digits}f} {b:.{digits}f}\t{c:.{digits}f}  12.5" for a, b, c in rotation]
    path = tmp_path / "sop.dat"
    path.write_text(head + "\n".join(rows) + f"  # right\n\n{last}\n")
    return path


def test_matrix_is_read_as_written(tmp_path):
    matrix = read_matrix(write_matrix(tmp_path, ROTATION))
    assert matrix[:3, :3] == pytest.approx(ROTATION, abs=1e-15)
    assert list(matrix[:3, 3]) == [12.5, 12.5, 12.5]
    assert list(matrix[3]) == [0, 0, 0, 1]


@pytest.mark.parametrize("digits", [9, 7])
def test_few_digits_are_enough(tmp_path, digits):
    assert read_matrix(write_matrix(tmp_path, ROTATION, digits=digits))[:3, :3] == pytest.approx(
        ROTATION, abs=1e-6
    )


def test_rounded_rotation_is_made_orthonormal(tmp_path):
    rotation = read_matrix(write_matrix(tmp_path, ROTATION, digits=4))[:3, :3]
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-14)
    assert rotation == pytest.approx(ROTATION, abs=1e-4)
    assert np.abs(np.round(ROTATION, 4) @ np.round(ROTATION, 4).T - np.eye(3)).max() > 1e-6  # not orthonormal


@pytest.mark.parametrize(
    ("season", "tilt_deg"),
    [("2019-2020", None), ("2020-2021", None), ("2021-2022", None), ("2023-2024", 33.8)],
)
@pytest.mark.parametrize("kind", ["SOP", "POP"])
def test_real_matrices_are_accepted(shared_data, season, kind, tilt_deg):
    matrix = read_matrix(shared_data / f"mammoth/{season}-{kind}.dat")
    assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3), abs=1e-8)
    if kind == "SOP" and tilt_deg:
        assert np.degrees(np.arccos(matrix[2, 2])) == pytest.approx(tilt_deg, abs=0.1)
    if kind == "POP":
        assert 6.36e6 < np.linalg.norm(matrix[:3, 3]) < 6.39e6  # on the Earth


@pytest.mark.parametrize(
    ("rotation", "last", "reason"),
    [
        (ROTATION * 1000, "0 0 0 1", "also scales by 1000"),
        (ROTATION * [1, 1, -1], "0 0 0 1", "is a reflection"),
        (ROTATION + [[0, 0, 0.01]] * 3, "0 0 0 1", "not at right angles"),
        (ROTATION, "0 0 0 2", "last row must be 0 0 0 1"),
        (ROTATION, "0 0 1", r"rows of \[4, 4, 4, 3\]"),
        (ROTATION, "", r"rows of \[4, 4, 4\]"),
        (ROTATION, "0 0 0 eins", "could not convert"),
        (ROTATION * [1, 1, np.nan], "0 0 0 1", "not a finite number"),
    ],
)
def test_invalid_matrix_is_explained(tmp_path, rotation, last, reason):
    with pytest.raises(ConfigError, match=reason):
        read_matrix(write_matrix(tmp_path, rotation, last=last))


@pytest.mark.parametrize("value", ["1e200", "-1e300", "2e8"])
@pytest.mark.parametrize("column", [0, 3])
def test_values_beyond_any_map_are_rejected(tmp_path, value, column):
    rows = np.eye(4).astype(str)
    rows[0, column] = value
    (tmp_path / "sop.dat").write_text("\n".join(" ".join(row) for row in rows))
    with pytest.raises(ConfigError, match="beyond any map"):
        read_matrix(tmp_path / "sop.dat")


def test_transposed_matrix_is_recognised(tmp_path):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ROTATION, (1, 2, 3)
    np.savetxt(tmp_path / "t.dat", matrix.T)
    with pytest.raises(ConfigError, match="transposed"):
        read_matrix(tmp_path / "t.dat")


def test_missing_matrix_is_a_config_error(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_matrix(tmp_path / "none.dat")


OCTOBER, MAY = datetime(2024, 10, 1, tzinfo=UTC), datetime(2025, 5, 1, tzinfo=UTC)
SOPS = [
    SopSection.model_validate({"from": MAY, "file": Path("may.dat")}),
    SopSection.model_validate({"from": OCTOBER, "file": Path("october.dat")}),
]


@pytest.mark.parametrize(
    ("when", "file"),
    [
        (OCTOBER, "october.dat"),
        (MAY - timedelta(seconds=1), "october.dat"),
        (MAY, "may.dat"),
        (MAY + timedelta(days=999), "may.dat"),
    ],
)
def test_latest_sop_that_has_begun_is_valid(when, file):
    assert valid_sop(SOPS, when).file == Path(file)


def test_time_before_the_first_sop_is_rejected():
    with pytest.raises(ScanError, match=r"no \[\[sop\]\] .* has begun by 2024-09-30 23:59:59"):
        valid_sop(SOPS, OCTOBER - timedelta(seconds=1))


NUMBERS = np.eye(4)
NUMBERS[:3, :3], NUMBERS[:3, 3] = ROTATION, (12.5, -3.25, 1500.0)
SIXTEEN = " ".join(f"{number:.16f}" for number in NUMBERS.ravel())
ROWS = "\n".join(" ".join(f"{number:.12f}" for number in row) for row in NUMBERS)
QUATERNION = Rotation.from_matrix(ROTATION).as_quat()  # x, y, z, w
PLACE = "x = 12.5\ny = -3.25\nz = 1500\n"


def test_each_position_has_its_sops():
    later = OCTOBER + timedelta(days=1)
    sops = [
        SopSection.model_validate({"from": begin, "file": file, "files": files})
        for begin, file, files in (
            (OCTOBER, "1a", "*/ScanPos001*"), (later, "1b", "*/ScanPos001*"), (OCTOBER, "2", "*/ScanPos002*"),
        )
    ]  # fmt: skip
    assert valid_sop(sops, OCTOBER, "day/ScanPos001.laz").file == Path("1a")
    assert valid_sop(sops, later, "day/ScanPos001.laz").file == Path("1b")
    assert valid_sop(sops, later, "day/ScanPos002.laz").file == Path("2")
    assert valid_sop(sops, later).file == Path("1b")  # the position listed first
    with pytest.raises(ScanError, match=r"no \[\[sop\]\] of the site file is for day/ScanPos003.laz"):
        valid_sop(sops, later, "day/ScanPos003.laz")
    others = SopSection.model_validate({"from": OCTOBER, "file": "rest"})
    assert valid_sop([*sops, others], later, "day/ScanPos003.laz").file == Path("rest")


@pytest.mark.parametrize(
    "text",
    [
        SIXTEEN,
        f'<?xml version="1.0"?>\n<sop kind="SOP"><matrix rows="4" cols="4"> {SIXTEEN} </matrix></sop>',
        ROWS.replace(".", ","),
        "\n".join(";".join(line.split()) for line in ROWS.replace(".", ",").split("\n")),
        "\n".join(", ".join(line.split()) for line in ROWS.split("\n")),
        "\n".join(",".join(line.split()) for line in ROWS.split("\n")),
        PLACE + "qx = {}\nqy = {}\nqz = {}\nqw = {}  # the real part".format(*QUATERNION),
        PLACE.replace("=", ":") + "roll_deg: {}\npitch_deg: {}\nyaw_deg: {}".format(
            *np.degrees([0.1, 0.59, -1.2])
        ),
        '{{\n"x": 12.5,\n"y": -3.25,\n"z": 1500,\n"roll_deg": {},\n"pitch_deg": {},\n"yaw_deg": {}}}'.format(
            *np.degrees([0.1, 0.59, -1.2])
        ),
    ],
)  # fmt: skip
def test_a_matrix_is_accepted_in_any_form(tmp_path, text):
    """ROTATION is from the angles 0.1, 0.59, -1.2 about x, y, z by scipy."""
    path = tmp_path / "sop.dat"
    path.write_text(text)
    assert read_matrix(path) == pytest.approx(NUMBERS, abs=1e-10)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<project><matrix>1</matrix><matrix>2</matrix></project>", "has 2 elements.*station import riscan"),
        ("<project/>", "has 0 elements"),
        ("<sop><matrix>", "not valid XML"),
        (PLACE + "qw = 1\nqx = 0\nqy = 0.5\nqz = 0", "length of 1.11803, not 1"),
        (PLACE + "roll_deg = 1", "needs x, y, z and qw"),
        (PLACE + "qw = 1\nqx = 0\nqy = 0\nqz = 0\nscale = 2", "has x, y, z, qw.*scale"),
        ("x = west", "could not convert"),
        (" ".join("1" * 15), r"16 in one line, has rows of \[15\]"),
    ],
)
def test_other_forms_are_refused_with_a_reason(tmp_path, text, reason):
    path = tmp_path / "sop.dat"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        read_matrix(path)


def test_entities_do_not_expand_without_limit(tmp_path):
    entities = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 20}">' for n in range(1, 12))
    path = tmp_path / "sop.xml"
    path.write_text(f'<!DOCTYPE s [<!ENTITY a0 "1 ">{entities}]><sop><matrix>&a11;</matrix></sop>')
    with pytest.raises(ConfigError, match="not valid XML"):
        read_matrix(path)


@pytest.mark.parametrize("text", ["x=" + "," * 1_000_000 + " x", "x = " + "1" * 1_000_000, "\n" * 1_000_000])
def test_a_long_line_is_refused_at_once(tmp_path, text):
    """An expression that tries all of its parts would take hours."""
    (tmp_path / "sop.dat").write_text(text)
    with pytest.raises(ConfigError, match="needs 4 rows of 4 numbers"):
        read_matrix(tmp_path / "sop.dat")
