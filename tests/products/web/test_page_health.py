"""Health in words: is sigma right at every distance, which scans were not good and why, what happened."""

import json
import re
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from station.archive import epochs
from station.archive.series import index
from station.archive.series.virtual import build_series
from station.products.epoch_table import EpochTable, read_epoch_table
from station.products.web import page_health
from station.products.web.page_text import LANGUAGES, PAGE_TEXT, PageText, format_number
from station.quantities import Measurement, Quality
from station.queries.stable_ground import z_by_range
from station.science.adjustment.ground_classes import is_holdout

DAY_S, NOON_S = 86_400.0, datetime(2025, 11, 20, 12, tzinfo=UTC).timestamp()
ENGLISH = PAGE_TEXT["en"]


def table_of(start_s, verdict, reason=None):
    count = len(start_s)
    return EpochTable(
        np.asarray(start_s), np.asarray(start_s) + 900, verdict, {},
        {"verdict_reason": reason or [""] * count},
    )  # fmt: skip


@pytest.fixture
def with_stable_ground(series, small):
    """The archive with one more scan, all of it stable: sigma right within 250 m, half of what it should be
    beyond."""
    grid, rng = small.GRID, np.random.default_rng(5)
    east_m, north_m = grid.x_m[0], grid.y_m[0]
    range_m = np.hypot(grid.x_m[None, :] - east_m, grid.y_m[:, None] - north_m)
    sigma_m = np.full(grid.shape, 0.02, np.float32)
    error_m = 0.02 * rng.normal(size=grid.shape) * np.where(range_m < 250, 1.0, 2.0)
    epoch = small.make_epoch(12)
    measurement = Measurement.from_rasters(
        grid,
        np.full(grid.shape, Quality.STABLE_GROUND, np.uint8),
        elevation_m=np.full(grid.shape, 2800.0),
        change_m=error_m.astype(np.float32),
        uncertainty_m=sigma_m,
        systematic_uncertainty_m=np.zeros(grid.shape, np.float32),
        spread_m=sigma_m,
        count=np.full(grid.shape, 4, np.int32),
    )
    scalars = epoch.scalars | {"scanner_east": east_m, "scanner_north": north_m, "scanner_height": 2800.0}
    epochs.write_epoch(series, replace(epoch, measurement=measurement, scalars=scalars))
    build_series(series)
    held_out = is_holdout(
        *(values.ravel() for values in np.broadcast_arrays(grid.x_m[None], grid.y_m[:, None]))
    )
    return series, range_m.ravel()[held_out], error_m.ravel()[held_out] / 0.02


def test_sigma_is_judged_at_each_distance(with_stable_ground, tmp_path):
    series, range_m, z = with_stable_ground
    rows = z_by_range(series, index.list_epochs(series)[-1])
    assert [row[:2] for row in rows] == [(100.0, 250.0), (250.0, 500.0), (500.0, 1000.0)]
    assert sum(row[2] for row in rows) == len(z)
    for low_m, high_m, cells, z_std in rows:
        inside = (range_m >= low_m) & (range_m < high_m)
        assert cells == np.count_nonzero(inside)
        expected = 1.4826 * np.median(np.abs(z[inside] - np.median(z[inside])))
        assert z_std == pytest.approx(expected, rel=0.02)  # stored steps
    by_range = page_health.calibration_by_range(series, read_epoch_table(series), tmp_path, ENGLISH)
    by_words = {row.range: row for row in by_range}
    assert 0.75 < by_words["100 to 250 m"].z < 1.3
    assert by_words["250 to 500 m"].status == by_words["500 to 1000 m"].status == "too_small"
    assert 1.7 < by_words["250 to 500 m"].factor < 2.4
    summary = page_health.summary_of_sigma(None, by_range)
    assert summary["status"] == "too_small"  # one word over all would be the mean of right and wrong
    assert "250" in summary["range"] or "500" in summary["range"]


def test_stable_ground_of_a_scan_is_read_once(with_stable_ground, tmp_path, monkeypatch):
    series, *_ = with_stable_ground
    table, calls = read_epoch_table(series), []
    monkeypatch.setattr(
        page_health, "z_by_range", lambda _, epoch: calls.append(epoch.epoch_file) or [(0.0, 100.0, 30, 1.0)]
    )
    for _ in range(6):
        page_health.calibration_by_range(series, table, tmp_path, ENGLISH)
    assert sorted(calls) == [
        table.texts["epoch_file"][position] for position in (0, 6)
    ]  # one in twelve hours
    (tmp_path / ".calibration.json").write_text("{damaged")
    (row,) = page_health.calibration_by_range(series, table, tmp_path, ENGLISH)
    assert (row.range, row.scans) == ("up to 100 m", page_health.READ_SCANS)


def test_timeline_counts_verdicts_and_missing_scans():
    start_s = NOON_S + 3600.0 * np.array(
        [0, 1, 2, 3, 9, 10, 11, 12, 13, 14]
    )  # five missing, then after midnight
    verdict = ["good", "good", "degraded", "good", "good", "good", "good", "good", "unusable", "good"]
    today, yesterday = page_health.timeline(table_of(start_s, verdict), 3600.0, start_s[-1] + 1800)
    assert yesterday.date == "2025-11-20"
    assert yesterday.counts == {"good": 6, "degraded": 1, "missing": 5}
    assert today.counts == {"good": 2, "unusable": 1}
    assert [(run.verdict, run.begin_min) for run in yesterday.runs] == [
        ("good", 720), ("degraded", 840), ("good", 900), ("good", 1260),
    ]  # fmt: skip
    assert yesterday.runs[0].length_min == pytest.approx(114)
    assert all(run.begin_min + run.length_min <= 1440 for run in yesterday.runs)
    assert page_health.timeline(table_of([], []), 3600.0, NOON_S) == []


def test_timeline_shows_a_day_without_any_scan_and_no_more_than_its_days():
    start_s = NOON_S + DAY_S * np.array([0.0, 30.0, 32.0])
    days = page_health.timeline(table_of(start_s, ["good"] * 3), 3600.0, start_s[-1])
    assert len(days) == page_health.DAYS
    assert days[1].counts == {"missing": 24}


def test_reasons_are_grouped_and_explained():
    fog = "41% of the usually visible cells observed, none beyond 900 m: fog, snowfall or snow on the window?"
    more = fog.replace("41", "12")
    log = "inclination log missing"
    table = table_of(
        NOON_S + 3600.0 * np.arange(5),
        ["degraded", "good", "unusable", "degraded", "degraded"],
        [f"{fog}; {log}", "", more, "odd thing of 1.5 m", "odd thing of 2.5 m"],
    )
    found = {reason.key: reason for reason in page_health.reasons(table)}
    assert {key: reason.count for key, reason in found.items()} == {"fog": 2, "log": 1, "other": 2}
    assert (found["fog"].message, found["fog"].verdict) == (more, "unusable")
    assert found["fog"].newest_s == NOON_S + 7200


@pytest.mark.parametrize(
    ("message", "key"),
    [
        ("flagged: crane in view", "flagged"),
        ("partial sweep: no points at azimuth 105-120 degrees", "sweep"),
        ("inclination log 3.0 s late (± 0.2 s) by the ground: it is not used", "clock"),
        ("inclination log has a gap of 300 s", "log"),
        ("scanner tilted by 0.120 degrees against its SOP: moved?", "moved"),
        ("no stable ground observed", "stable"),
        ("hold-out stable ground scatters by 3.4 sigma", "scatter"),
        ("0.31% of the echoes are not from the ground: snow, rain or dust?", "airborne"),
        ("no brightness: snow on stable ground cannot be recognised", "brightness"),
        ("registration missing: placed by the SOP", "registration"),
        ("something new", "other"),
    ],
)
def test_each_reason_has_its_explanation(message, key):
    assert page_health.explanation(message) == key
    assert all(PAGE_TEXT[language][f"reason_{key}"] for language in LANGUAGES)


def test_log_tells_references_scans_measured_again_and_alarms(series):
    again = [(NOON_S + 100, 8, NOON_S, NOON_S + 7200)]
    entries = page_health.log_entries(series, again, [(NOON_S, "alarm: no scan for 5 h")], ENGLISH)
    texts = [entry["text"] for entry in entries]
    assert texts[-2:] == [
        "8 scans measured again, of 2025-11-20 12:00 to 2025-11-20 14:00 UTC",
        "alarm: no scan for 5 h",
    ]
    assert [entry["time_s"] for entry in entries] == sorted((e["time_s"] for e in entries), reverse=True)


def test_languages_have_the_same_texts_and_fields():
    for language in LANGUAGES:
        assert PAGE_TEXT[language].keys() == ENGLISH.keys()
        for key, text in PAGE_TEXT[language].items():
            fields = re.findall(r"\{\w+\}", text)
            assert sorted(fields) == sorted(re.findall(r"\{\w+\}", ENGLISH[key])), key
    assert json.dumps(PAGE_TEXT["de"]) != json.dumps(ENGLISH)


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_grid_on_a_plane_has_words_of_its_own(language):
    """Nothing sinks on a rock face, and its axes are not those of the map."""
    of_map, of_plane = (PageText.of(language, on_map=on_map) for on_map in (True, False))
    for usual, other in ((of_map.page, of_plane.page), (of_map.viewer, of_plane.viewer)):
        assert other.keys() == usual.keys()
        for key, text in other.items():
            fields = re.findall(r"\{\w+\}", text)
            assert sorted(fields) == sorted(re.findall(r"\{\w+\}", usual[key])), key
    words = " ".join([of_plane.page["map_alt"], *of_plane.viewer.values(), of_plane.page["easting"]])
    upward = ("sank", "stieg", "rose", "Höhe", "easting", "Easting", "Ostwert", "levation")
    assert [word for word in upward if word in words] == []
    assert "key_change" in of_plane.script


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(-0.0004, 3, "+0.000"), (-0.0006, 3, "−0.001"), (12345.6, 0, "+12\u202f346"), (float("nan"), 2, "–")],
)
def test_numbers_have_no_negative_zero(value, digits, text):
    assert format_number(value, digits, sign=True) == text
