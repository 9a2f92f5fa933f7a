"""Words of any language in the store, as the program and other people's read them."""

import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import store
from station.archive.join import join_closed
from station.archive.layout import kept_of, strings, text
from station.archive.series import build_series
from station.archive.variables import TEXT_LENGTH

WORDS = "Hütte – 5°"


@pytest.fixture
def built(series, epoch):
    """Two epochs, one of them with words beyond ASCII."""
    told = {**epoch(1).provenance, "sop_id": "Sommer-Größe", "flag": WORDS}
    store.write_epoch(series, epoch(0))
    store.write_epoch(series, replace(epoch(1), verdict_reason=WORDS, scan_id="Scan_é", provenance=told))
    return build_series(series)


def test_texts_come_back():
    words = [WORDS, "", "plain", "氷河"]
    assert strings(text(words, "text")) == words
    assert [kept_of(word, "text") for word in words] == words


def test_texts_are_cut_between_characters():
    for start in range(4):
        long = "x" * start + "°–" * 60
        (told,) = strings(text([long], "text"))
        assert told == kept_of(long, "text")
        assert long.startswith(told)
        assert TEXT_LENGTH["text"] - 2 <= len(told.encode()) <= TEXT_LENGTH["text"]


def test_names_that_no_encoding_has_are_kept_as_far_as_can_be():
    name = b"scan_\xff.laz".decode("utf-8", "surrogateescape")
    assert strings(text([name], "text")) == [kept_of(name, "text")] == ["scan_?.laz"]


def test_ascii_of_old_reads_as_before():
    old = np.array([b"sop-1", b"a reason?"], dtype="S64")
    assert strings(netCDF4.stringtochar(old)) == ["sop-1", "a reason?"]


def test_the_series_says_the_words(built, series):
    with station.open(series.folder) as told:
        assert told.verdict_reason.values.tolist() == ["", WORDS]
        assert told.sop_id.values.tolist() == ["sop-1", "Sommer-Größe"]
    for path in (built, store.epochs(series)[1].path):
        assert store.said(path)["verdict_reason"] in ("", WORDS)
        with netCDF4.Dataset(path) as told:
            assert told["scan_id"]._Encoding == "utf-8"
            assert told["scan_id"][-1] == "Scan_é"
            assert told["flag"][-1] == WORDS
    join_closed(series, datetime(2025, 12, 24, tzinfo=UTC), lambda: None)
    with station.open(series.folder) as told:
        assert told.verdict_reason.values.tolist() == ["", WORDS]


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_xarray_says_the_words(built, engine):
    with xr.open_dataset(built, engine=engine) as told:
        assert told.verdict_reason.values.tolist() == ["", WORDS]
        assert told.scan_id.values.tolist()[1] == "Scan_é"


def run(name, *command):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return subprocess.run([path, *command], capture_output=True, check=True, timeout=120)


def test_ncdump_says_the_words(built):
    """Bytes beyond ASCII in octal, as of any characters."""
    octal = "".join(chr(byte) if byte < 128 else f"\\{byte:03o}" for byte in WORDS.encode())
    assert octal in run("ncdump", "-v", "verdict_reason", built).stdout.decode()


def test_cdo_does_not_stumble(built):
    assert b"elevation_change" in run("cdo", "infon", built).stdout


@pytest.mark.usefixtures("built")
def test_a_series_of_old_is_read_and_rewritten(series, epoch):
    """An epoch whose texts say ascii, beside new ones."""
    path = store.epochs(series)[0].path
    with netCDF4.Dataset(path, "a") as file:
        for variable in file.variables.values():
            if "_Encoding" in variable.ncattrs():
                variable.setncattr("_Encoding", "ascii")
    store.write_epoch(series, epoch(2))
    with xr.open_dataset(build_series(series)) as told:
        assert told.scan_id.values.tolist() == ["251121_000000", "Scan_é", "251121_020000"]
