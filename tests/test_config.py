"""The site file: every fault at once, in words that say what to do."""

import pytest

from station.config import read_site
from station.errors import ConfigError

GOOD = """
[station]
id = "x"
data = "data"
[scans]
inbox = "inbox"
frame = "map"
[grid]
bounds_m = { west = 0.0, south = 0.0, east = 10.0, north = 20.0 }
cell_m = 0.5
"""


def read(tmp_path, text):
    path = tmp_path / "site.toml"
    path.write_text(text)
    return read_site(path)


def test_paths_are_relative_to_the_file(tmp_path):
    site = read(tmp_path, GOOD)
    assert site.scans.inbox == tmp_path / "inbox"
    assert site.station.data == tmp_path / "data"
    assert site.grid_cells.shape == (40, 20)
    assert site.instrument.beam_divergence_rad == pytest.approx(0.12e-3)


def test_all_faults_at_once_with_the_nearest_right_key(tmp_path):
    text = (
        GOOD.replace('id = "x"', 'id = "a b"')
        .replace("frame", "fram")
        .replace("cell_m = 0.5", "cell_m = 0.3")
    )
    with pytest.raises(ConfigError) as error:
        read(tmp_path, text + '[uncertainty]\nmodel = "best"\n')
    told = str(error.value)
    assert "site.toml: 4 to mend" in told
    assert "scans.fram: no such key; did you mean 'frame'?" in told
    assert "station.id" in told
    assert "make it a whole number" in told
    assert "uncertainty.model" in told


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[station]", "[station"), "not valid TOML"),
        (('frame = "map"', 'frame = "scanner"'), "needs an"),
        (("[grid]", '[scanner]\nmodel = "vz"\n[grid]'), "take one of riegl-vz-6000"),
        (("[grid]", "[scanner]\nmodel = []\n[grid]"), "scanner.model: .* string"),
        (("[station]", "scanner = 5\n[station]"), "scanner: .* dictionary"),
        (("[grid]", '[reference]\nscans = "there.tif"\n[grid]'), "no such file"),
        (("[grid]", '[adjustment]\nstable = "there.geojson"\n[grid]'), r"adjustment.stable: no such file"),
        (("[grid]", '[adjustment]\nmethod = "best"\n[grid]'), "adjustment.method"),
        (("[grid]", '[areas]\nfile = "there.geojson"\n[grid]'), r"areas.file: no such file"),
        (("[grid]", "[products]\nquicklook_width_px = 100\n[grid]"), "products.quicklook_width_px"),
        (("[grid]", "[products]\nchange_limit_m = 0\n[grid]"), "products.change_limit_m"),
        (("[grid]", "[areas]\n[grid]"), "areas.file: missing"),
        (("[grid]", '[map]\npop = "pop.dat"\n[grid]'), "say which with map.crs"),
        (("east = 10.0", "east = -10.0"), "at least one cell_m beyond"),
        (("cell_m = 0.5", "cell_m = 0.001"), "too many"),
        (("cell_m = 0.5", "cell_m = 1e-320"), "grid.cell_m"),
        (("east = 10.0", "east = 1e300"), "grid.bounds_m.east"),
        (("cell_m = 0.5", "cell_m = nan"), "grid.cell_m"),
    ],
)
def test_faults_say_what_to_do(tmp_path, change, says):
    with pytest.raises(ConfigError, match=says):
        read(tmp_path, GOOD.replace(*change))


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_site(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="is a folder"):
        read_site(tmp_path)


def test_only_what_changes_numbers_changes_the_hash(tmp_path):
    one = read(tmp_path, GOOD).science_hash
    assert read(tmp_path, GOOD.replace('inbox = "inbox"', 'inbox = "other"')).science_hash == one
    assert read(tmp_path, GOOD.replace("cell_m = 0.5", "cell_m = 1.0")).science_hash != one


def test_stable_ground_counts_by_what_the_file_says(tmp_path):
    (tmp_path / "one.geojson").write_text("{}")
    (tmp_path / "same.geojson").write_text("{}")
    (tmp_path / "other.geojson").write_text("[]")
    auto = read(tmp_path, GOOD)
    assert (auto.adjustment.method, auto.adjustment.stable) == ("joint", "auto")
    wording = GOOD + '[adjustment]\nstable = "{}.geojson"\n'
    one, same, other = (read(tmp_path, wording.replace("{}", name)) for name in ("one", "same", "other"))
    assert one.adjustment.stable == tmp_path / "one.geojson"
    assert one.science_hash == same.science_hash
    assert len({auto.science_hash, one.science_hash, other.science_hash}) == 3


def test_areas_change_no_epoch(tmp_path):
    (tmp_path / "areas.geojson").write_text("{}")
    site = read(tmp_path, f'{GOOD}[areas]\nfile = "areas.geojson"\n')
    assert site.areas.file == tmp_path / "areas.geojson"
    assert site.science_hash == read(tmp_path, GOOD).science_hash


def test_only_what_changes_numbers_of_every_epoch_changes_the_hash(tmp_path):
    """Whatever an epoch names itself, and whatever keeps house, leaves it alone."""
    columns = 'columns = {{ temperature_c = "{}", humidity_pct = "H", pressure_hpa = "P" }}'
    weather = f'[weather]\nfile = "w.dat"\n{columns}\n'
    (tmp_path / "flags.csv").write_text("from,to,reason\n")
    one = read(tmp_path, GOOD + weather.format("T")).science_hash
    for more in (
        weather.format("T2"),  # other air: the epochs it changes tell by their own
        weather.format("T") + '[flags]\nfile = "flags.csv"\n',
        weather.format("T") + '[retention]\nraw = "delete"\n',
        weather.format("T") + "[service]\nmemory_gb = 3\n",
    ):
        assert read(tmp_path, GOOD + more).science_hash == one
    for more in (
        weather.format("T") + "max_age_s = 60\n",
        weather.format("T") + "[reference]\nscans = 3\n",
        weather.format("T") + "[inclination]\ncutoff_hz = 0.1\n",
    ):
        assert read(tmp_path, GOOD + more).science_hash != one
