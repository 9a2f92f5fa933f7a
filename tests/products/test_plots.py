"""Plots of maps, films and curves."""

import pytest
from PIL import Image

from station.errors import StationError
from station.products.area_tables import Span, area_records
from station.products.plots import plot_curve, plot_film, plot_map

ALL = Span.parse(None, None)


@pytest.mark.integration
def test_plots_of_maps_films_and_curves(site, tmp_path, small):
    for variable in ("change", "sigma", "points"):
        path = plot_map(site, "last", "reference", variable, tmp_path / f"{variable}.png", 500, None)
        with Image.open(path) as picture:
            assert picture.width == 500
    plot_map(site, "251121_040000", "previous", "change", tmp_path / "pair.webp", 500, 0.5)
    with pytest.raises(StationError, match="no earlier epoch"):
        plot_map(site, "251121_000000", "previous", "change", tmp_path / "first.png", 500, 0.5)
    with pytest.raises(StationError, match="must end in"):
        plot_map(site, "last", "reference", "change", tmp_path / "map.tiff", 500, None)
    for suffix in ("webp", "gif"):
        path = plot_film(site, Span.parse("2025-11-21T01:00", None), tmp_path / f"film.{suffix}", 400, None)
        with Image.open(path) as film:
            assert film.n_frames == 5
    with pytest.raises(StationError, match="no epoch"):
        plot_film(site, Span.parse("2030-01-01", None), tmp_path / "film.webp", 400, None)
    path = plot_curve(area_records(site, None, ALL, "reference"), small.EVIL, "x", tmp_path / "curve.svg")
    svg = path.read_text()
    assert "onerror" not in svg.replace("&lt;img src=x onerror=alert(1)&gt;", "")
    with pytest.raises(StationError, match="no area 'gone' with a change; available: rises"):
        plot_curve(area_records(site, None, ALL, "reference"), "gone", "x", tmp_path / "curve.png")
