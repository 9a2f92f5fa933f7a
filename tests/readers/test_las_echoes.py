"""Which echoes of a LAS file are ground, and their intensity."""

import struct

import laspy
import numpy as np
import pytest

from station.errors import ScanError
from station.readers.las import LasScan

# Return number, number of returns, class, withheld, synthetic, overlap; and whether the echo is ground.
ECHOES = [
    ((1, 1, 0, 0, 0, 0), True),
    ((1, 2, 2, 0, 0, 0), False),  # snowflake in front of the ground …
    ((2, 2, 2, 0, 0, 0), True),  # … and the ground
    ((4, 5, 2, 0, 0, 0), False),
    ((5, 5, 2, 0, 0, 0), True),
    ((0, 0, 2, 0, 0, 0), True),  # return numbers not filled in
    ((1, 0, 2, 0, 0, 0), True),
    ((0, 1, 2, 0, 0, 0), True),
    ((3, 2, 2, 0, 0, 0), True),  # wrong, but not before the last
    ((1, 1, 7, 0, 0, 0), False),
    ((1, 1, 18, 0, 0, 0), False),
    ((1, 1, 6, 0, 0, 0), True),
    ((1, 1, 8, 0, 0, 0), True),
    ((1, 1, 23, 0, 0, 0), True),  # 7 in the lowest bits
    ((1, 1, 2, 1, 0, 0), False),
    ((1, 1, 2, 0, 1, 0), True),
    ((1, 1, 2, 0, 0, 1), True),
    ((1, 1, 7, 1, 1, 1), False),
]
FORMATS = [(f"f{number}.las", number) for number in range(11)] + [
    (f"f{number}.laz", number) for number in (0, 1, 2, 3, 6, 7, 8)
]
WHITE = 0.25  # intensity of a white surface read from decibels


@pytest.fixture
def write_echoes(tmp_path):
    """Return a function that writes echoes at x = 0, 1, 2 … with given columns, and returns the path."""

    def write(name, count, point_format=6, extra=(), **columns):
        header = laspy.LasHeader(point_format=point_format, version="1.4")
        header.scales, header.offsets = [0.001] * 3, [0.0] * 3
        for dimension in extra:
            header.add_extra_dim(dimension)
        las = laspy.LasData(header)
        las.x, las.y, las.z = np.arange(float(count)), np.full(count, 50.0), np.zeros(count)
        for column, values in columns.items():
            las[column] = values
        las.write(tmp_path / name)
        return tmp_path / name

    return write


def read(path, size=50_000, range_max_m=None, **options):
    """Return x [m] and intensity of the echoes that a scan yields."""
    blocks = list(LasScan(path, range_max_m=range_max_m).blocks(size, **options))
    assert all(len(block) for block in blocks)
    x_m = np.concatenate([block.xyz_m[0] for block in blocks])
    if blocks[0].intensity is None:
        assert all(block.intensity is None for block in blocks)
        return x_m, None
    return x_m, np.concatenate([block.intensity for block in blocks])


def reflectance(kind="int16", scale=0.01, name="Reflectance"):
    scaled = {} if scale is None else {"scales": np.array([scale]), "offsets": np.array([0.0])}
    return laspy.ExtraBytesParams(name, kind, **scaled)


@pytest.mark.parametrize("size", [1, 7, 50_000])
@pytest.mark.parametrize(("name", "point_format"), FORMATS)
def test_last_returns_that_are_neither_withheld_nor_noise_are_ground(write_echoes, name, point_format, size):
    repeats = 30
    number, count, code, withheld, synthetic, overlap = np.tile([row for row, _ in ECHOES], (repeats, 1)).T
    columns = {
        "return_number": number,
        "number_of_returns": count,
        "classification": code,
        "withheld": withheld,
        "synthetic": synthetic,
        "intensity": np.arange(len(number)),
    }
    if point_format >= 6:
        columns["overlap"] = overlap
    if point_format >= 1 and point_format != 2:
        columns["gps_time"] = 100 + np.arange(len(number)) / 10
    path = write_echoes(name, len(number), point_format, **columns)
    x_m, intensity = read(path, size)
    expected = np.flatnonzero(np.tile([is_ground for _, is_ground in ECHOES], repeats))
    assert np.array_equal(np.rint(x_m), expected)
    assert intensity * 65535 == pytest.approx(expected)
    if "gps_time" in columns:
        time_s = np.concatenate([block.time_s for block in LasScan(path).blocks(size)])
        assert time_s == pytest.approx(100 + expected / 10)
    assert LasScan(path).header.point_count == len(number)


def test_scan_without_ground_is_rejected(write_echoes):
    path = write_echoes("first.laz", 500, return_number=np.ones(500, int), number_of_returns=[2] * 500)
    with pytest.raises(ScanError, match=r"none of its 500 points is a last or only return"):
        read(path)


def test_withheld_echo_may_be_out_of_range(write_echoes):
    withheld = (np.arange(100) > 80).astype(int)
    path = write_echoes("far.laz", 100, withheld=withheld)
    assert len(read(path, range_max_m=95.0)[0]) == 81  # at 80 m and 50 m sideways: 94.3 m
    with pytest.raises(ScanError, match=r"an echo 94 m away"):
        read(path, range_max_m=93.0)


def test_azimuth_track_of_a_scan_with_noise(write_echoes):
    """Noise at the beginning of every other block: the track has its times from the others."""
    count = 4000
    noise = np.where(np.arange(count) // 30 % 2 == 0, 7, 1)
    path = write_echoes("noise.laz", count, classification=noise, gps_time=40 + np.arange(count) / 100)
    track = LasScan(path, range_max_m=5000.0).azimuth_track()
    assert len(track.time_s) > 80
    x_m = (track.time_s - 40) * 100
    assert track.azimuth_rad == pytest.approx(np.arctan2(50.0, x_m))


@pytest.mark.parametrize(("name", "point_format"), [("a.las", 1), ("a.laz", 1), ("a.las", 7), ("a.laz", 7)])
@pytest.mark.parametrize(
    ("kind", "scale", "title"),
    [
        ("int16", 0.01, "Reflectance"),
        ("int32", 0.001, "reflectance"),
        ("float32", None, "REFLECTANCE"),
        ("float64", None, "Reflectance"),
    ],
)
def test_reflectance_in_decibels_becomes_linear(write_echoes, name, point_format, kind, scale, title):
    """A tenth for every 10 dB, a half for 3.01 dB; 6 dB above white is clipped, as a reflector is."""
    relative_db = np.tile([0.0, -10.0, -20.0, -3.01, 3.01, 20.0], 500)
    path = write_echoes(
        name,
        3000,
        point_format,
        [laspy.ExtraBytesParams("Amplitude", "uint16"), reflectance(kind, scale, title)],
        intensity=np.arange(3000),
        Amplitude=np.arange(3000),
        **{title: relative_db},
    )
    expected = np.tile([WHITE, WHITE / 10, WHITE / 100, WHITE / 2, WHITE * 2, 1.0], 500)
    for mode in ("auto", "reflectance"):
        assert read(path, 700, intensity=mode)[1] == pytest.approx(expected, rel=1e-3)
    assert read(path, intensity="linear")[1] * 65535 == pytest.approx(np.arange(3000))
    assert read(path, intensity="none")[1] is None


def test_dark_rock_far_away_is_resolved_to_one_percent(write_echoes):
    """In the 16 bits in which cells sum intensity; snow is not clipped."""
    relative_db = np.linspace(-25, 5, 1000)
    path = write_echoes("a.laz", 1000, 6, [reflectance(scale=0.001)], Reflectance=relative_db)
    stored = np.rint(read(path)[1] * 65535)
    assert stored / stored[-1] == pytest.approx(10 ** ((relative_db - 5) / 10), rel=0.011)
    assert stored.max() < 65535


def test_intensity_that_is_decibels_becomes_linear(write_echoes):
    """PDAL: 0 is -25 dB, 65535 is 5 dB; so 54612.5 is 0 dB and 32767.5 is -10 dB."""
    values = np.tile([54612, 54613, 32767, 32768, 65535], 100)
    path = write_echoes("a.laz", 500, intensity=values)
    expected = np.tile([WHITE, WHITE, WHITE / 10, WHITE / 10, WHITE * 10**0.5], 100)
    assert read(path, intensity="decibel")[1] == pytest.approx(expected, rel=1e-3)


def test_intensity_of_8_bits_is_linear(write_echoes):
    values = np.arange(1000) % 256
    path = write_echoes("a.laz", 1000, intensity=values)
    assert read(path)[1] / read(path)[1].max() == pytest.approx(values / 255)


@pytest.mark.parametrize("constant", [0, 1, 65535])
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_constant_intensity_is_no_brightness(write_echoes, name, constant):
    path = write_echoes(name, 2000, intensity=np.full(2000, constant))
    for mode in ("auto", "linear", "decibel", "reflectance"):
        x_m, intensity = read(path, intensity=mode)
        assert len(x_m) == 2000
        assert intensity is None


def test_constant_reflectance_is_replaced_by_intensity_only_if_the_choice_is_free(write_echoes):
    path = write_echoes("a.laz", 500, 6, [reflectance()], intensity=np.arange(500))
    assert read(path)[1] * 65535 == pytest.approx(np.arange(500))
    assert read(path, intensity="reflectance")[1] is None


@pytest.mark.integration
def test_intensity_that_begins_after_the_first_chunk_is_brightness(write_echoes):
    values = np.where(np.arange(120_000) < 50_000, 0, 300)
    path = write_echoes("a.laz", 120_000, intensity=values)
    assert read(path)[1] * 65535 == pytest.approx(values)


def test_reflectance_that_is_not_a_number_is_unknown(write_echoes):
    values = np.tile(np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0], np.float32), 100)
    path = write_echoes("a.laz", 600, 6, [reflectance("float32", None)], Reflectance=values)
    expected = np.tile([0.0, 1.0, 0.0, 1.0, 0.0, WHITE], 100)
    assert read(path)[1] == pytest.approx(expected, abs=1e-6)
    path = write_echoes("b.laz", 600, 6, [reflectance("float32", None)], Reflectance=np.full(600, np.nan))
    assert read(path)[1] is None


def patch_entry(path, index, offset, code, value):
    """Change a field of the description of extra bytes: LAS 1.4 R15, table 24."""
    raw = bytearray(path.read_bytes())
    first = raw.index(b"LASF_Spec") - 2 + 54 + 192 * index
    struct.pack_into(code, raw, first + offset, value)
    path.write_bytes(raw)


@pytest.mark.parametrize(
    ("offset", "code", "value"),
    [
        (2, "B", 0),  # undocumented bytes, whose number is in the options
        (2, "B", 11),  # two numbers
        (2, "B", 31),  # reserved types
        (2, "B", 255),
        (112, "d", np.nan),  # scale
        (112, "d", 0.0),
        (112, "d", np.inf),
        (136, "d", np.nan),  # offset
        (2, "B", 10),  # eight bytes, beyond the record
        (4, "32s", b"\xff" * 32),  # name
        (4, "32s", b""),
    ],
)
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_hostile_extra_bytes_are_ignored(write_echoes, name, offset, code, value):
    path = write_echoes(
        name, 500, 6, [reflectance()], intensity=np.arange(500), Reflectance=-np.arange(500) / 50
    )
    patch_entry(path, 0, offset, code, value)
    assert read(path, intensity="reflectance")[1] is None
    assert read(path)[1] * 65535 == pytest.approx(np.arange(500))


def test_the_first_of_two_reflectances_is_used(write_echoes):
    relative_db = np.tile([0.0, -10.0], 250)
    extra = [laspy.ExtraBytesParams("Other", "uint8"), reflectance(), reflectance(name="Reflectancf")]
    path = write_echoes("a.las", 500, 6, extra, Reflectance=relative_db, Reflectancf=-relative_db)
    patch_entry(path, 2, 4, "32s", b"Reflectance")
    assert read(path)[1] == pytest.approx(np.tile([WHITE, WHITE / 10], 250), rel=1e-3)


@pytest.mark.parametrize("kind", ["int64", "uint64", "uint8", "int8"])
def test_reflectance_of_any_integer_type_is_read(write_echoes, kind):
    extremes = np.array([np.iinfo(kind).min, np.iinfo(kind).max, 0], kind)
    path = write_echoes("a.laz", 300, 6, [reflectance(kind, None)], Reflectance=np.tile(extremes, 100))
    intensity = read(path)[1]
    assert intensity[1::3] == pytest.approx(1.0)
    assert intensity[2::3] == pytest.approx(WHITE)


def test_reflectance_of_a_riegl_export(shared_data):
    """Decoded independently: return numbers in byte 14, dB in hundredths in bytes 30 and 31."""
    path = shared_data / "las_samples/1.2-empty-geotiff-vlrs.las"
    rows = np.frombuffer(path.read_bytes()[8398:], np.uint8).reshape(43, 34)
    last = (rows[:, 14] & 7) == (rows[:, 14] >> 3 & 7)
    relative_db = rows[last, 30:32].copy().view("<i2")[:, 0] / 100
    x_m, intensity = read(path)
    assert len(x_m) == np.count_nonzero(last) < 43
    assert -22 < relative_db.min() < relative_db.max() < 0
    assert intensity == pytest.approx(WHITE * 10 ** (relative_db / 10))
    assert read(path, intensity="linear")[1] is None  # its intensity is zero
