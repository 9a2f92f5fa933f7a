"""Rates of areas: of a known rise, of periods, as text, CSV and by the command."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from station.cli import app
from station.errors import StationError
from station.products.area_tables import Span, area_records
from station.products.trend_tables import TrendRecord, as_csv, as_text, trend_records
from station.science.time_series.trend import Trend

ALL = Span.parse(None, None)


def test_rate_of_a_known_rise(site):
    """One area rises and the other falls by 5 cm an hour."""
    records = list(trend_records(site, None, ALL))
    assert [record.epochs for record in records] == [6, 6]
    for record, true_m_d in zip(records, (1.2, -1.2), strict=True):
        trend = record.trend
        assert abs(trend.rate_m_d - true_m_d) < 3 * trend.rate_sigma_m_d
        assert trend.rate_sigma_m_d < 0.05
        assert abs(trend.acceleration_m_d2) < 3 * trend.acceleration_sigma_m_d2
        inverse, sigma = record.inverse_velocity_d_m
        assert inverse == pytest.approx(1 / abs(trend.rate_m_d))
        assert sigma / inverse == pytest.approx(trend.rate_sigma_m_d / abs(trend.rate_m_d))


def test_unusable_epochs_are_left_out(site, monkeypatch):
    def flagged(*arguments):
        for record in area_records(*arguments):
            yield replace(record, verdict="unusable") if record.start.hour == 2 else record

    monkeypatch.setattr("station.products.trend_tables.area_records", flagged)
    assert [record.epochs for record in trend_records(site, None, ALL)] == [5, 5]


@pytest.mark.integration
def test_rates_of_periods_and_of_one_area(site):
    (whole,) = trend_records(site, None, ALL, "rises")
    (day,) = trend_records(site, None, ALL, "rises", "1D")
    assert day == whole
    (later,) = trend_records(site, None, Span.parse("2025-11-21T02:00", None), "rises")
    assert later.epochs < whole.epochs


@pytest.mark.parametrize(
    ("span", "area", "message"),
    [
        (ALL, "nowhere", "no area 'nowhere'; areas: rises, "),
        (Span.parse("2025-11-21T04:00", None), None, "a rate needs 3 usable epochs"),
    ],
)
def test_unknown_areas_and_short_spans_are_errors(site, span, area, message):
    with pytest.raises(StationError, match=message):
        list(trend_records(site, None, span, area))


def record(rate, acceleration, sigma=0.1):
    time = Span.parse("2026-01-01", None).first
    return TrendRecord("slope", time, time, 9, Trend(rate, sigma, acceleration, sigma))


@pytest.mark.parametrize(
    ("rate", "acceleration", "word"),
    [
        (1.0, 1.0, "speeds up"),
        (-1.0, -1.0, "speeds up"),
        (-1.0, 1.0, "slows down"),
        (1.0, 0.1, ""),
        (0.1, 1.0, ""),
    ],
)
def test_text_says_what_is_significant(rate, acceleration, word):
    *_, line = as_text([record(rate, acceleration)]).splitlines()
    assert line.split("±0.1960")[-1].strip() == word


def test_inverse_velocity_of_an_insignificant_rate_is_empty():
    rows = csv.DictReader(io.StringIO(as_csv([record(0.1, 0.0), record(-0.5, np.nan)])))
    assert [(row["inverse_velocity_d_m"], row["acceleration_m_d2"]) for row in rows] == [("", "0"), ("2", "")]


@pytest.mark.integration
@pytest.mark.usefixtures("site")
def test_command_prints_text_or_csv(tmp_path):
    path = str(tmp_path / "site.toml")
    text = CliRunner().invoke(app, ["trend", path, "--area", "rises"])
    assert text.exit_code == 0
    assert "speeds up" not in text.output
    table = CliRunner().invoke(app, ["trend", path, "--every", "1D", "--csv", "-"])
    (rises, falls) = csv.DictReader(io.StringIO(table.stdout))
    assert float(rises["rate_m_d"]) == pytest.approx(1.2, abs=0.1)
    assert float(falls["rate_m_d"]) == pytest.approx(-1.2, abs=0.1)
