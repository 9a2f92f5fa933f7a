"""The site file: all faults at once, each with its remedy; its JSON Schema."""

import json
import re
import tomllib
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from station.config import KINDS, SCHEMA_NAME, read_site, site_schema, write_site
from station.errors import ConfigError
from station.grid_plane import GridPlane
from station.processing.scanner_pose import sop_identity
from station.scanners import KEYS, SCANNERS, missing_values
from station.sections.inputs import ScannerSection

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


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:99999", "unknown to PROJ: name a projected CRS in metres"),
        ("local", "unknown to PROJ: name a projected CRS in metres, such as EPSG:32632, or omit it"),
        ("EPSG:4326", "is a Geographic 2D CRS, in degrees"),
        ("EPSG:4978", "is a Geocentric CRS"),
        ("EPSG:2263", "is in US survey foot"),
        ("+proj=utm +zone=32 +units=ft", "is in foot"),
    ],
)
def test_map_must_be_projected_and_in_metres(tmp_path, crs, message):
    with pytest.raises(ConfigError, match=re.escape(f"map.crs: {message}")):
        read(tmp_path, f'{GOOD}[map]\ncrs = "{crs}"\n')
    assert read(tmp_path, f'{GOOD}[map]\ncrs = "EPSG:32632+5773"\n').map.crs


PLANE = "plane = { origin_m = [1.0, 2.0, 3.0], facing_deg = 200.0 }"


def on_plane(text=GOOD, plane=PLANE):
    return text.replace("[grid]\n", f"[grid]\n{plane}\n")


def test_a_grid_on_a_plane_has_its_own_coordinates(tmp_path):
    site = read(tmp_path, f'{on_plane()}[map]\ncrs = "EPSG:32632"\n')
    assert site.grid_cells.plane == GridPlane((1.0, 2.0, 3.0), 200.0, 90.0)
    assert (site.grid_crs, site.map.crs) == (None, "EPSG:32632")
    on_map = read(tmp_path, GOOD)
    assert on_map.grid_cells.plane.is_map
    assert len({site.science_hash, on_map.science_hash, read(tmp_path, on_plane()).science_hash}) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (on_plane(plane=PLANE.replace("200.0", "400.0")), "facing_deg: should be less than or equal to 360"),
        (on_plane() + '[uncertainty]\nmodel = "voordendag2023"\n', "its terms are those of heights"),
        (on_plane() + "[uncertainty]\nstore_terms = true\n", "its terms are those of heights"),
        (
            on_plane() + '[[product]]\nname = "ice"\nkind = "melt"\ndensity_kg_m3 = 900\nat = [0.0, 0.0]\n',
            "product 'ice' of kind melt is counted upward",
        ),
    ],
)
def test_what_has_no_meaning_on_a_plane_is_a_fault(tmp_path, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        read(tmp_path, text)


@pytest.mark.parametrize("name", ["%y_%y", "%q", "%Y%m%d%", "%H(%M"])
def test_name_that_is_no_pattern_of_times_is_a_fault(tmp_path, name):
    text = GOOD.replace("frame", f'name = "{name}"\nframe')
    if name == "%H(%M":
        assert read(tmp_path, text).scans.name == name
        return
    with pytest.raises(ConfigError, match=r"scans\.name: not a pattern of times, such as %y%m%d_%H%M%S"):
        read(tmp_path, text)


@pytest.mark.parametrize("data", ["inbox", "inbox/data", ".", "other/../inbox"])
def test_data_and_inbox_must_be_separate(tmp_path, data):
    with pytest.raises(ConfigError, match="must be separate folders"):
        read(tmp_path, GOOD.replace('data = "data"', f'data = "{data}"'))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[sop]]\nfrom = 2025-07-15T00:00:00\nfile = "s"\n', "sop.0.from: give the time zone: Z at the end"),
        ("[flags]\nfile = 3\n", "flags.file: give a path in quotes (given: 3)"),
        (
            '[air]\nscanner_setting = "wether"\n',
            "air.scanner_setting: should be 'weather' or a table of keys (given: 'wether')",
        ),
        (
            '[inclination]\ncutoff_hz = "slow"\n',
            "inclination.cutoff_hz: should be 'auto' or a number (given: 'slow')",
        ),
        (
            '[[sop]]\nfrom = "yesterday"\nfile = "sop.dat"\n',
            "sop.0.from: give a date and time in UTC, as 2025-07-14T23:00:00Z (given: 'yesterday')",
        ),
        ('[[sop]]\nfrom = 2025-07-15T00:00:00Z\nfile = "s"\n' * 2, "two [[sop]] have the same from"),
        (
            '[[sop]]\nfrom = 2025-07-15T00:00:00Z\nfile = "s"\nscanner = { model = "vz-400i" }\n',
            'scanners of different wavelengths see snow and rock differently: set scans.intensity = "none"',
        ),
        (
            '[[sop]]\nfrom = 2025-07-15T00:00:00Z\nfile = "s"\nscanner = { model = "P40" }\n',
            "sop.0.scanner: not all of leica-scanstation-p40 is known: give ",
        ),
    ],
)
def test_faults_are_reported_once_and_without_python_classes(tmp_path, more, message):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, GOOD + more)
    assert "1 to fix" in str(error.value)
    assert message in str(error.value)


def test_unreadable_file_is_a_fault_not_a_traceback(tmp_path):
    (tmp_path / "flags.csv").mkdir()
    with pytest.raises(ConfigError, match=r"flags\.file: .*flags\.csv: cannot be read: Is a directory"):
        read(tmp_path, GOOD + '[flags]\nfile = "flags.csv"\n')


def test_all_faults_are_listed_with_the_closest_valid_key(tmp_path):
    text = (
        GOOD.replace('id = "x"', 'id = "a b"')
        .replace("frame", "fram")
        .replace("cell_m = 0.5", "cell_m = 0.3")
    )
    with pytest.raises(ConfigError) as error:
        read(tmp_path, text + '[uncertainty]\nmodel = "best"\n')
    message = str(error.value)
    assert "site.toml: 4 to fix" in message
    assert "scans.fram: no such key; did you mean 'frame'?" in message
    assert "station.id" in message
    assert "make it a whole number" in message
    assert "uncertainty.model" in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[station]", "[station"), "not valid TOML"),
        (
            ('frame = "map"', 'frame = "scanner"\n[map]\ncrs = "EPSG:32632"'),
            "map.crs needs an .* without both, the map is local",
        ),
        (
            ('frame = "map"', 'frame = "scanner"\n[inclination]\nmode = "relative"'),
            'the log makes the map level: set inclination.mode = "absolute"',
        ),
        (("[grid]", '[scanner]\nmodel = "vz"\n[grid]'), "choose from riegl-vz-6000"),
        (("[grid]", "[scanner]\nmodel = []\n[grid]"), "scanner.model: .* string"),
        (("[station]", "scanner = 5\n[station]"), "scanner: give a table of keys"),
        (("[grid]", '[reference]\nscans = "there.tif"\n[grid]'), "no such file"),
        (("[grid]", '[adjustment]\nstable = "there.geojson"\n[grid]'), r"adjustment.stable: no such file"),
        (("[grid]", '[adjustment]\nmethod = "best"\n[grid]'), "adjustment.method"),
        (("[grid]", '[areas]\nfile = "there.geojson"\n[grid]'), r"areas.file: no such file"),
        (("[grid]", "[products]\nquicklook_width_px = 100\n[grid]"), "products.quicklook_width_px"),
        (("[grid]", "[products]\nchange_limit_m = 0\n[grid]"), "products.change_limit_m"),
        (("[grid]", "[areas]\n[grid]"), "areas.file: missing"),
        (("[grid]", '[map]\npop = "pop.dat"\n[grid]'), "need map.crs"),
        (("east = 10.0", "east = -10.0"), "at least one cell_m beyond"),
        (("cell_m = 0.5", "cell_m = 0.001"), "too many"),
        (("cell_m = 0.5", "cell_m = 1e-320"), "grid.cell_m"),
        (("east = 10.0", "east = 1e300"), "grid.bounds_m.east"),
        (("cell_m = 0.5", "cell_m = nan"), "grid.cell_m"),
    ],
)
def test_each_fault_is_explained(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, GOOD.replace(*change))


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_site(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="is a folder"):
        read_site(tmp_path)


def test_science_hash_depends_on_settings_that_change_results(tmp_path):
    original = read(tmp_path, GOOD).science_hash
    assert read(tmp_path, GOOD.replace('inbox = "inbox"', 'inbox = "other"')).science_hash == original
    assert read(tmp_path, GOOD.replace("cell_m = 0.5", "cell_m = 1.0")).science_hash != original


def test_science_hash_depends_on_the_content_of_the_stable_ground(tmp_path):
    (tmp_path / "one.geojson").write_text("{}")
    (tmp_path / "same.geojson").write_text("{}")
    (tmp_path / "other.geojson").write_text("[]")
    auto = read(tmp_path, GOOD)
    assert (auto.adjustment.method, auto.adjustment.stable) == ("joint", "auto")
    template = GOOD + '[adjustment]\nstable = "{}.geojson"\n'
    first, same, other = (read(tmp_path, template.replace("{}", name)) for name in ("one", "same", "other"))
    assert first.adjustment.stable == tmp_path / "one.geojson"
    assert first.science_hash == same.science_hash
    assert len({auto.science_hash, first.science_hash, other.science_hash}) == 3


def test_science_hash_does_not_depend_on_areas(tmp_path):
    (tmp_path / "areas.geojson").write_text("{}")
    site = read(tmp_path, f'{GOOD}[areas]\nfile = "areas.geojson"\n')
    assert site.areas.file == tmp_path / "areas.geojson"
    assert site.science_hash == read(tmp_path, GOOD).science_hash


def test_science_hash_excludes_what_each_epoch_records_and_housekeeping(tmp_path):
    columns = 'columns = {{ temperature_c = "{}", humidity_pct = "H", pressure_hpa = "P" }}'
    weather = f'[weather]\nfile = "w.dat"\n{columns}\n'
    (tmp_path / "flags.csv").write_text("from,to,reason\n")
    original = read(tmp_path, GOOD + weather.format("T")).science_hash
    for section in (
        weather.format("T2"),  # other air: each epoch records its own
        weather.format("T") + '[flags]\nfile = "flags.csv"\n',
        weather.format("T") + '[retention]\nraw = "delete"\n',
        weather.format("T") + "[service]\nmemory_gb = 3\n",
    ):
        assert read(tmp_path, GOOD + section).science_hash == original
    for section in (
        weather.format("T") + "max_age_s = 60\n",
        weather.format("T") + "[reference]\nscans = 3\n",
        weather.format("T") + "[inclination]\ncutoff_hz = 0.1\n",
    ):
        assert read(tmp_path, GOOD + section).science_hash != original


def as_json(value):
    """A TOML document with its times as text, as editors pass it to a validator."""
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [as_json(item) for item in value]
    return value.isoformat() if isinstance(value, datetime) else value


@pytest.mark.parametrize("name", KINDS.values())
def test_shipped_site_files_satisfy_the_schema(name):
    from jsonschema import Draft7Validator

    schema = json.loads(site_schema())
    Draft7Validator.check_schema(schema)
    text = (Path(__file__).parents[1] / "config" / f"{name}.toml").read_text(encoding="utf-8")
    document = as_json(tomllib.loads(text))
    assert not list(Draft7Validator(schema).iter_errors(document))
    document["scanner"] = {"model": "riegl-vz-400i"}  # its values are known
    assert not list(Draft7Validator(schema).iter_errors(document))


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("scans", "fram", "map"),
        ("scans", "frame", "maps"),
        ("grid", "cell_m", "1 m"),
        ("grid", "cell_m", 0),
        ("scanner", "beam_origin_m", [0, 0, 3]),
        ("scanner", "beam_origin_m", [0, 0]),
        ("sop", "from", "2024-10-01T00:00:00Z"),
        ("reference", "scans", 0),
    ],
)
def test_schema_rejects_invalid_keys_and_values(section, key, value):
    from jsonschema import Draft7Validator

    document = {**as_json(tomllib.loads(GOOD)), "reference": {}, "scanner": {}, "sop": {}}
    document[section] = {**document[section], key: value}
    assert list(Draft7Validator(json.loads(site_schema())).iter_errors(document))


def test_init_writes_the_schema_next_to_the_site_file(tmp_path):
    path = write_site(tmp_path / "station", "hef")
    directive, *_ = path.read_text(encoding="utf-8").splitlines()
    assert directive == f"#:schema ./{SCHEMA_NAME}"
    assert (path.parent / SCHEMA_NAME).read_text(encoding="utf-8") == site_schema()


def test_a_scanner_that_is_not_in_the_table_is_described_as_the_manual_says():
    manual = (Path(__file__).parents[1] / "docs" / "how-to" / "your-own-files.md").read_text()
    example = re.search(r'```toml\n(\[scanner\]\nmodel = "my-scanner".*?)```', manual, re.DOTALL)[1]
    values = tomllib.loads(example)["scanner"]
    scanner = ScannerSection(**values)
    assert (scanner.model, scanner.instrument.range_max_m) == ("my-scanner", 2000.0)
    del values["range_max_m"]
    with pytest.raises(ValidationError, match=r"unknown scanner 'my-scanner'.* or give range_max_m"):
        ScannerSection(**values)


def test_a_scanner_of_which_some_values_are_known_needs_only_the_others_which_the_manual_names():
    given = {"beam_divergence_mrad": 0.27, "range_sigma_m": 0.005, "range_max_m": 2500.0}
    scanner = ScannerSection(model="VZ-2000i", **given)
    assert (scanner.model, scanner.wavelength_um, scanner.range_max_m) == ("riegl-vz-2000i", 1.55, 2500.0)
    fault = "not all of riegl-vz-2000i is known: give beam_divergence_mrad, range_sigma_m, range_max_m"
    with pytest.raises(ValidationError, match=fault):
        ScannerSection(model="VZ-2000i")
    manual = (Path(__file__).parents[1] / "docs" / "how-to" / "your-own-files.md").read_text()
    rows = re.findall(r"^\| (`(?:riegl|leica|optech|livox)-.*?) \| (.*?) \|$", manual, re.MULTILINE)
    described = {}
    for models, keys in rows:
        named = set(re.findall("`(.*?)`", keys))
        described |= dict.fromkeys(
            re.findall("`(.*?)`", models), set(KEYS) - named if keys.startswith("all") else named
        )
    assert described == {name: set(missing_values(name)) for name in SCANNERS if missing_values(name)}


def test_a_scanner_of_its_own_counts_for_its_sop_alone(tmp_path):
    """Range, errors and identity; the table [scanner] is for all others."""
    np.savetxt(tmp_path / "s", np.eye(4))
    sop = '[[sop]]\nfrom = {year}-01-01T00:00:00Z\nfile = "s"\n'
    own = 'scanner = { model = "riegl-vz-6000", range_sigma_m = 0.02 }\n'
    text = GOOD.replace("map", "scanner") + sop.format(year=2024) + sop.format(year=2025) + own
    site = read(tmp_path, text + '[scanner]\nmodel = "VZ-400i"\nwavelength_um = 1.064\n')
    first, second = site.sop
    assert (site.scanner_of(first).model, site.scanner_of(None).model) == ("riegl-vz-400i", "riegl-vz-400i")
    assert (site.scanner_of(second).range_sigma_m, site.scanner_of(second).range_max_m) == (0.02, 6000.0)
    assert site.with_scanner_of(second).instrument.beam_divergence_rad == pytest.approx(0.12e-3)
    assert sop_identity(first) != sop_identity(second)  # epochs of another instrument are stale
    assert sop_identity(second) == sop_identity(second.model_copy(update={"from_": first.from_}))


POINT = '[[product]]\nname = "stake 1"\nkind = "point"\nat = [5, 5]\n'
BACKWARDS = "surface = { from = 2026-05-02T00:00:00Z, to = 2026-05-01T00:00:00Z }\n"
SHORELINE = '[[product]]\nname = "shore"\nkind = "contour"\nheight_m = 0.5\nline = [[1, 2], [3, 4]]\n'
ALARM = '[[alarms.product]]\nproduct = "{}"\nquantity = "elevation_change"\n'


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[product]]\nname = "a"\nkind = "snow_depth"\nat = [1, 2]\n', 'kind = "snow_depth" needs surface'),
        (f"{POINT}density_kg_m3 = 900\n", 'kind = "point" has no density_kg_m3; its keys: at, observations'),
        (f"{POINT}{POINT}", "two [[product]] have the name 'stake_1': rename one"),
        (f"{POINT}desity = 900\n", "product.0.desity: no such key; did you mean 'density_kg_m3'?"),
        (POINT.replace("point", "points"), "product.0.kind: should be 'point', 'snow_depth'"),
        ('[[product]]\nname = "a"\nkind = "volume_budget"\n', "product 'a' needs areas: give their file"),
        (
            '[[product]]\nname = "a"\nkind = "snow_depth"\nat = [1, 2]\n' + BACKWARDS,
            "to must be after from",
        ),
        ('[[product]]\nname = "a"\nkind = "profile"\nline = [[1, 2]]\n', "product.0.line: "),
        (f"{SHORELINE}count = 3\n", "count and spacing_m belong together"),
        (f"{SHORELINE.replace('[3, 4]', '[1, 2]')}count = 3\nspacing_m = 5\n", "line ends where it begins"),
        (
            POINT + ALARM.format("stake") + "above = 1\n",
            "alarms.product: no [[product]] has the name 'stake'",
        ),
        (POINT + ALARM.format("stake 1"), "give above or below, the level that raises the alarm"),
    ],
)
def test_products_that_contradict_themselves_are_refused(tmp_path, more, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        read(tmp_path, GOOD + more)


def test_parallel_lines_lie_to_the_right_of_the_first(tmp_path):
    """Of one that goes north they lie to the east."""
    north = SHORELINE.replace("[[1, 2], [3, 4]]", "[[1, 2], [1, 8], [1, 12]]")
    (product,) = read(tmp_path, GOOD + f"{north}count = 3\nspacing_m = 2.5\n").product
    assert product.lines == {
        f"{k:g} m": ((1 + k, 2), (1 + k, 8), (1 + k, 12)) for k in (0.0, 2.5, 5.0)
    }  # fmt: skip
    (single,) = read(tmp_path, GOOD + north).product
    assert single.lines == {"shore": ((1, 2), (1, 8), (1, 12))}


def test_products_have_the_paths_of_their_files(tmp_path):
    more = POINT + 'observations = "stake.csv"\n' + ALARM.format("Stake 1") + "above = 1\n"
    (product,) = read(tmp_path, GOOD + more).product
    assert (product.key, product.observations) == ("stake_1", tmp_path / "stake.csv")
