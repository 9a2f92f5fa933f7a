"""UTF-8 texts in the store, as this and other programs read them."""

import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import epochs
from station.archive.netcdf_layout import decode_text, encode_text, roundtrip_text
from station.archive.schema import TEXT_LENGTH
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series

TEXT = "Hütte – 5°"


@pytest.fixture
def built(series, epoch):
    """Two epochs, one of them with texts beyond ASCII."""
    provenance = {**epoch(1).provenance, "sop_id": "Sommer-Größe", "flag": TEXT}
    epochs.write_epoch(series, epoch(0))
    epochs.write_epoch(
        series, replace(epoch(1), verdict_reason=TEXT, scan_id="Scan_é", provenance=provenance)
    )
    return build_series(series)


def test_texts_read_back():
    texts = [TEXT, "", "plain", "氷河"]
    assert decode_text(encode_text(texts, "text")) == texts
    assert [roundtrip_text(text, "text") for text in texts] == texts


def test_long_texts_are_truncated_between_characters():
    for start in range(4):
        long = "x" * start + "°–" * 60
        (actual,) = decode_text(encode_text([long], "text"))
        assert actual == roundtrip_text(long, "text")
        assert long.startswith(actual)
        assert TEXT_LENGTH["text"] - 2 <= len(actual.encode()) <= TEXT_LENGTH["text"]


def test_bytes_that_are_not_utf8_become_question_marks():
    name = b"scan_\xff.laz".decode("utf-8", "surrogateescape")
    assert decode_text(encode_text([name], "text")) == [roundtrip_text(name, "text")] == ["scan_?.laz"]


def test_ascii_texts_of_older_files_are_decoded():
    old = np.array([b"sop-1", b"a reason?"], dtype="S64")
    assert decode_text(netCDF4.stringtochar(old)) == ["sop-1", "a reason?"]


@pytest.mark.integration
def test_epochs_and_series_return_the_texts_also_after_compaction(built, series):
    with station.open(series.folder) as ds:
        assert ds.verdict_reason.values.tolist() == ["", TEXT]
        assert ds.station.processing.sop_id.values.tolist() == ["sop-1", "Sommer-Größe"]
    for path in (built.with_name("processing.nc"), epochs.epoch_files(series)[1].path):
        assert epochs.read_provenance(path)["verdict_reason"] in ("", TEXT)
        with netCDF4.Dataset(path) as file:
            assert file["scan_id"]._Encoding == "utf-8"
            assert file["scan_id"][-1] == "Scan_é"
            assert file["flag"][-1] == TEXT
    compact(series, datetime(2025, 12, 24, tzinfo=UTC), lambda: None)
    with station.open(series.folder) as ds:
        assert ds.verdict_reason.values.tolist() == ["", TEXT]


@pytest.mark.parametrize("engine", ["netcdf4", pytest.param("h5netcdf", marks=pytest.mark.integration)])
def test_xarray_reads_the_texts(built, engine):
    with xr.open_dataset(built, engine=engine) as ds:
        assert ds.verdict_reason.values.tolist() == ["", TEXT]
        assert ds.scan_id.values.tolist()[1] == "Scan_é"


def run(name, *command):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return subprocess.run([path, *command], capture_output=True, check=True, timeout=120)


@pytest.mark.integration
def test_ncdump_prints_the_texts(built):
    """It prints bytes beyond ASCII in octal."""
    octal = "".join(chr(byte) if byte < 128 else f"\\{byte:03o}" for byte in TEXT.encode())
    assert octal in run("ncdump", "-v", "verdict_reason", built).stdout.decode()


@pytest.mark.integration
def test_cdo_reads_the_file(built):
    assert b"elevation_change" in run("cdo", "infon", built).stdout


@pytest.mark.usefixtures("built")
def test_an_older_epoch_with_ascii_texts_joins_a_series_with_newer_ones(series, epoch):
    path = epochs.epoch_files(series)[0].path
    with netCDF4.Dataset(path, "a") as file:
        for variable in file.variables.values():
            if "_Encoding" in variable.ncattrs():
                variable.setncattr("_Encoding", "ascii")
    epochs.write_epoch(series, epoch(2))
    with xr.open_dataset(build_series(series)) as ds:
        assert ds.scan_id.values.tolist() == ["251121_000000", "Scan_é", "251121_020000"]
