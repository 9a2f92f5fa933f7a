"""A scan of the largest station: its memory goes with the cells seen, its time hardly beyond decoding."""

import pytest

from benchmarks.large import decoded, large_station, measured, prepared, referenced

MOST_GB = 0.65
GROWTH = 1.1  # forty times the points see some two million more cells, whose sums take 20 bytes each
POINTS = (1_440_000, 14_400_000, 57_600_000)
MOST_BYTES_A_CELL = 155  # of a reference in the making: 137, and 250 where scans are added as a whole


@pytest.mark.slow
def test_memory_is_bounded_by_the_grid_not_by_the_points(tmp_path):
    """4,000 x 5,000 cells, with the reference and the adjustment."""
    peaks_gb = [measured(prepared(tmp_path, points)).peak_gb for points in POINTS]
    assert max(peaks_gb) <= MOST_GB
    assert max(peaks_gb) <= GROWTH * min(peaks_gb)


@pytest.mark.slow
def test_the_memory_that_a_reference_is_made_in_goes_with_its_cells(tmp_path):
    """1,000 x 1,250 and 2,000 x 2,500 cells: what the larger takes more."""
    peaks_gb = [referenced(large_station(tmp_path, 100_000, size=size)).peak_gb for size in (0.25, 0.5)]
    more_cells = 4000 * 5000 * (0.5**2 - 0.25**2)
    assert (peaks_gb[1] - peaks_gb[0]) * 1e9 <= MOST_BYTES_A_CELL * more_cells


def test_a_small_one_of_its_kind_is_adjusted_and_good(tmp_path):
    site = prepared(tmp_path, 250_000, size=0.08)
    taken = measured(site)  # decodes ahead; raises where it is of no use
    assert taken.points == pytest.approx(250_000, rel=0.02)
    scan = max((site.parent / "inbox").glob("*.laz"))
    assert decoded(scan).points == taken.points
    assert large_station(tmp_path, 250_000, size=0.08) == site  # and not made again
