"""A logger's clock that is wrong is told from the stored series, not from a single scan."""

from types import SimpleNamespace

import netCDF4
import numpy as np
import pytest

from station.archive.layout import Series
from station.errors import StoreError
from station.quantities import Grid
from station.service import health, late_log
from station.service.journal import Journal

NAMES = ("log_lateness", "log_lateness_uncertainty")


@pytest.fixture
def told(tmp_path, monkeypatch):
    """Return what is said of a series of lateness and its sigma."""
    series = Series(tmp_path, "hef", Grid(0.0, 20.0, 10.0, 3, 2), None)
    monkeypatch.setattr(late_log, "series_of", lambda _: series)

    def told(late_s, sigma_s, names=NAMES):
        with netCDF4.Dataset(series.path, "w") as file:
            file.createDimension("time", len(late_s))
            for name, values in zip(names, (late_s, sigma_s), strict=True):
                file.createVariable(name, "f8", ("time",), fill_value=9.96921e36)[:] = np.ma.masked_invalid(
                    values
                )
        return late_log.late_log(SimpleNamespace())

    return told


def drawn(seed, mean_s, count=24):
    """What scans say of clocks that differ by 2 s about a mean: a third clearly, the others hardly."""
    random = np.random.default_rng(seed)
    sigma_s = np.where(np.arange(count) % 3 == 0, 0.8, 5.0)
    late_s = mean_s + 2 * random.standard_normal(count)
    worth = 5.8**2 / (5.8**2 + sigma_s**2)  # drawn to nought as far as they do not know
    return worth * (late_s + sigma_s * random.standard_normal(count)), sigma_s


def test_a_lasting_lateness_is_told_and_a_passing_one_is_not(told):
    assert not any(told(*drawn(seed, 0.0)) for seed in range(200))
    said = [told(*drawn(seed, 5.0)) for seed in range(20)]
    assert sum(bool(text) for text in said) >= 18
    assert all("s late (±" in text and "clock of the logger" in text for text in said if text)
    assert "s early" in told(*drawn(1, -6.0))
    one, sigma_s = drawn(2, 0.0)
    one[5] = 9.0
    assert told(one, sigma_s) == ""


def test_scans_that_say_nothing_do_not_count(told):
    late_s, sigma_s = drawn(3, 6.0)
    late_s[:-5] = np.nan
    assert told(late_s, sigma_s) == ""
    late_s, sigma_s = drawn(3, 6.0)
    late_s[::4] = np.nan
    assert "the last 18 scans" in told(late_s, sigma_s)


def test_a_series_of_an_older_version_says_nothing(told):
    assert told(*drawn(1, 6.0), names=("a", "b")) == ""


def test_status_says_it(told, tmp_path, monkeypatch):
    """Beside a journal, as a person asks for it."""
    monkeypatch.setattr("station.service.moved.moved", lambda _: "")
    monkeypatch.setattr("station.service.stale.count_by_settings", lambda _: 0)
    told(*drawn(1, 6.0))
    with Journal(tmp_path / "journal.sqlite"):
        pass
    site = SimpleNamespace(
        station=SimpleNamespace(id="hef", name="Hef", data=tmp_path),
        scans=SimpleNamespace(inbox=tmp_path, expected_every_s=3600.0),
        grid=SimpleNamespace(shape=(2, 3)),
        adjusts=True,
    )
    assert any("clock of the logger" in fault for fault in health.status(site)["faults"])
    site.adjusts = False
    assert not any("clock of the logger" in fault for fault in health.status(site)["faults"])


def test_a_damaged_series_is_an_error(told, tmp_path):
    told(*drawn(1, 6.0))
    (tmp_path / "series.nc").write_bytes(b"no such thing")
    with pytest.raises(StoreError, match="cannot be read"):
        late_log.late_log(SimpleNamespace())
