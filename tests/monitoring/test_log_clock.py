"""Clock offset of the inclination logger, estimated from the stored series."""

from types import SimpleNamespace

import netCDF4
import numpy as np
import pytest

from station.archive.netcdf_layout import Series
from station.errors import StoreError
from station.inbox.journal import Journal
from station.monitoring import log_clock, status
from station.quantities import Grid

NAMES = ("log_offset", "log_clock_offset", "log_clock_offset_uncertainty")


@pytest.fixture
def problem_of(tmp_path, monkeypatch):
    """Return a function: the reported problem of a series of clock offsets and their sigma [s].

    Large ones were corrected before the scan was adjusted; what remains of them is zero.
    """
    series = Series(tmp_path, "hef", Grid(0.0, 20.0, 10.0, 3, 2), None)
    monkeypatch.setattr(log_clock, "series_for", lambda _: series)

    def report(offset_s, sigma_s, names=NAMES):
        with netCDF4.Dataset(series.path, "w") as file:
            file.createDimension("time", len(offset_s))
            corrected_s = np.where(np.abs(offset_s) > 3.5, offset_s, 0.0)
            for name, values in zip(names, (corrected_s, offset_s - corrected_s, sigma_s), strict=True):
                file.createVariable(name, "f8", ("time",), fill_value=9.96921e36)[:] = np.ma.masked_invalid(
                    values
                )
        return log_clock.log_clock_offset(SimpleNamespace())

    return report


def draw(seed, mean_s, count=24):
    """Draw estimates of clock offsets that scatter by 2 s; every third is precise, the others are not."""
    rng = np.random.default_rng(seed)
    sigma_s = np.where(np.arange(count) % 3 == 0, 0.8, 5.0)
    offset_s = mean_s + 2 * rng.standard_normal(count)
    shrinkage = 5.8**2 / (5.8**2 + sigma_s**2)  # the prior shrinks uncertain estimates to zero
    return shrinkage * (offset_s + sigma_s * rng.standard_normal(count)), sigma_s


@pytest.mark.integration
def test_lasting_offset_is_reported_and_a_single_one_is_not(problem_of):
    assert not any(problem_of(*draw(seed, 0.0)) for seed in range(200))
    problems = [problem_of(*draw(seed, 5.0)) for seed in range(20)]
    assert sum(bool(text) for text in problems) >= 18
    assert all("s late (±" in text and "clock of the logger" in text for text in problems if text)
    assert "s early" in problem_of(*draw(1, -6.0))
    offset_s, sigma_s = draw(2, 0.0)
    offset_s[5] = 9.0
    assert problem_of(offset_s, sigma_s) == ""


def test_scans_without_an_estimate_do_not_count(problem_of):
    offset_s, sigma_s = draw(3, 6.0)
    offset_s[:-5] = np.nan
    assert problem_of(offset_s, sigma_s) == ""
    offset_s, sigma_s = draw(3, 6.0)
    offset_s[::4] = np.nan
    assert "the last 18 scans" in problem_of(offset_s, sigma_s)


def test_series_without_the_variables_reports_nothing(problem_of):
    assert problem_of(*draw(1, 6.0), names=("a", "b", "c")) == ""


def test_status_lists_the_offset_among_the_faults(problem_of, tmp_path, monkeypatch):
    """The station has a journal, like a running one."""
    monkeypatch.setattr("station.monitoring.pose_stability.latest_step", lambda _: "")
    monkeypatch.setattr("station.processing.staleness.count_outdated", lambda *_: 0)
    monkeypatch.setattr("station.processing.usable_inputs.usable_site", lambda site: site)
    problem_of(*draw(1, 6.0))
    with Journal(tmp_path / "journal.sqlite"):
        pass
    site = SimpleNamespace(
        station=SimpleNamespace(id="hef", name="Hef", data=tmp_path),
        scans=SimpleNamespace(inbox=tmp_path, expected_every_s=3600.0, suffix=None, pattern="%y%m%d_%H%M%S"),
        inclination=None,
        epoch=None,
        registration=None,
        grid=SimpleNamespace(shape=(2, 3)),
        publish=None,
        adjusts=True,
        weather=None,
        mirror=None,
        product=(),
        products=SimpleNamespace(levels=False),
        input_faults=(),
    )
    assert any("clock of the logger" in fault for fault in status.status(site)["faults"])
    site.adjusts = False
    assert not any("clock of the logger" in fault for fault in status.status(site)["faults"])


def test_damaged_series_is_an_error(problem_of, tmp_path):
    problem_of(*draw(1, 6.0))
    (tmp_path / "series.nc").write_bytes(b"no such thing")
    with pytest.raises(StoreError, match="cannot be read"):
        log_clock.log_clock_offset(SimpleNamespace())
