"""The documentation agrees with the code: README, generated reference, commented site files."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from station import config
from station.config import read_site, write_site
from station.scanners import SCANNERS, scanner_model
from station.sections.site_file import SiteFile

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
SITES = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "config").glob("*.toml"))


def commands():
    text = subprocess.run(
        [sys.executable, "-m", "station", "--help"], capture_output=True, text=True, check=True
    ).stdout
    return re.findall(r"^  ([a-z]+)  ", text[text.index("Commands:") :], re.MULTILINE)


def test_every_command_is_in_the_readme():
    names = commands()
    assert {"init", "check", "process", "run", "status", "simulate", "demo"} <= set(names)
    for command in names:
        assert f"`station {command}" in README


def keys(model):
    for name, field in model.model_fields.items():
        inner = [model for model in config._models_in(field.annotation) if issubclass(model, BaseModel)]
        yield field.alias or name
        for section in inner:
            yield from keys(section)


def test_every_key_of_the_site_file_is_in_the_examples():
    optional = {"exit_diameter_m", "registration_sigma_m", "time"}  # overrides for other instruments and logs
    missing = [key for key in set(keys(SiteFile)) - optional if not re.search(rf"\b{key}\b", SITES)]
    assert not missing


@pytest.mark.parametrize("like", config.KINDS)
def test_site_files_are_complete(tmp_path, like):
    """They can be read as they are, but for the files with the SOP of a station, and its polygons."""
    site = write_site(tmp_path, like)
    text = site.read_text(encoding="utf-8")
    for name in re.findall(r'^(?:stable|file) = "([^"]+\.geojson)"', text, re.MULTILINE):
        (tmp_path / name).write_text("{}")
    for name in re.findall(r'(?:file|pop) = "([^"]+\.dat)"', text):
        (tmp_path / name).write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert read_site(site).station.id == like
    with pytest.raises(config.ConfigError, match="nothing is overwritten"):
        write_site(tmp_path, like)


def test_instrument_values_equal_those_of_the_papers():
    """Voordendag et al. (2023), section 2.2; Hartzell et al. (2015), Table 1."""
    vz6000 = SCANNERS["riegl-vz-6000"]
    assert (vz6000["wavelength_um"], vz6000["beam_divergence_mrad"]) == (1.064, 0.12)
    assert vz6000["inclination_sigma_deg"] == 0.008
    vz4000 = SCANNERS["riegl-vz-4000"]
    assert (vz4000["wavelength_um"], vz4000["beam_divergence_mrad"], vz4000["exit_diameter_m"]) == (
        1.55, 0.15, 0.018,
    )  # fmt: skip
    z390 = SCANNERS["riegl-lms-z390i"]
    assert (z390["beam_divergence_mrad"], z390["range_sigma_m"]) == (0.30, 0.004)


def test_instrument_values_equal_those_of_helios():
    """HELIOS++, scanners_tls.xml: accuracy_m and beamDivergence_rad; 0.03° by 0.28° for the Livox."""
    expected = {"riegl-vz-400": (0.005, 0.3), "riegl-vz-600i": (0.005, 0.35), "riegl-vz-1000": (0.008, 0.3)}
    rms_mrad = (((0.000523598**2 + 0.004887**2) / 2) ** 0.5) * 1e3
    expected |= {name: (0.02, pytest.approx(rms_mrad, rel=0.01)) for name in ("livox-mid-40", "livox-mid-70")}
    for name, values in expected.items():
        assert (SCANNERS[name]["range_sigma_m"], SCANNERS[name]["beam_divergence_mrad"]) == values


def test_instrument_values_equal_those_of_manuals_and_published_code():
    """Livox HAP, manual, table 1.2.1; Z+F IMAGER 5016, half-angle 0.3 mrad and 0.004° (one sigma)."""
    hap, imager = SCANNERS["livox-hap"], SCANNERS["zf-imager-5016"]
    assert (hap["wavelength_um"], hap["range_sigma_m"], hap["range_max_m"]) == (0.905, 0.02, 150.0)
    assert (imager["wavelength_um"], imager["beam_divergence_mrad"]) == (1.5, 0.6)
    assert imager["angle_resolution_deg"] / 12**0.5 == pytest.approx(0.004, rel=0.01)


def test_beams_stated_at_half_maximum_are_converted():
    """Leica P30/P40: 0.23 mrad, 3.5 mm; BLK360: 0.4 mrad, 2.25 mm. Half of a Gaussian: .5887 of 1/e²."""
    for name, mrad, diameter_m in (("scanstation-p40", 0.23, 0.0035), ("blk360", 0.4, 0.00225)):
        values = SCANNERS[f"leica-{name}"]
        expected = [mrad / 0.5887, diameter_m / 0.5887]
        actual = [values["beam_divergence_mrad"], values["exit_diameter_m"]]
        assert actual == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("VZ-6000", "riegl-vz-6000"), ("Riegl VZ 6000", "riegl-vz-6000"), ("RIEGL_VZ-400i", "riegl-vz-400i"),
        ("vz400", "riegl-vz-400"), ("Livox Mid-70", "livox-mid-70"), ("VZ-9000", None), ("", None),
        ("Z+F IMAGER 5016", "zf-imager-5016"), ("imager 5016", "zf-imager-5016"),
        ("Zoller+Fröhlich 5016", "zf-imager-5016"), ("Leica ScanStation P40", "leica-scanstation-p40"),
        ("P40", "leica-scanstation-p40"), ("BLK360", "leica-blk360"), ("Z420i", "riegl-lms-z420i"),
        ("Teledyne Optech ILRIS 3D", "optech-ilris-3d"), ("VZ-2000i", "riegl-vz-2000i"),
        ("Leica P20", "leica-scanstation-p20"), ("ScanStation P50", "leica-scanstation-p50"),
        ("Teledyne Optech Polaris", "optech-polaris"), ("Livox Tele-15", "livox-tele-15"),
    ],
)  # fmt: skip
def test_scanners_are_known_by_the_names_that_people_write(name, model):
    assert scanner_model(name) == model


@pytest.fixture(scope="module")
def generator():
    spec = importlib.util.spec_from_file_location("generate_reference", DOCS / "generate_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_committed_pages_are_those_of_the_code(generator):
    for name, expected in generator.generated_pages().items():
        actual = (DOCS / "reference" / name).read_text(encoding="utf-8")
        assert actual == expected, f"{name}: run python docs/generate_reference.py"


def test_every_log_key_is_described(generator):
    assert not generator.log_keys() - set(generator.LOG_KEYS)


def test_the_readme_stays_short():
    assert len(README.splitlines()) <= 150
    assert len(README.split()) <= 1200


def test_the_paper_has_what_its_journal_demands():
    """Sections and date as JOSS asks for them; citations and references are the same; articles have a DOI."""
    text, bib = ((DOCS / f"paper/paper.{ending}").read_text(encoding="utf-8") for ending in ("md", "bib"))
    entries = dict(re.findall(r"^@\w+\{(\w+),(.*?)^\}", bib, re.MULTILINE | re.DOTALL))
    assert set(re.findall(r"@(\w+)", text)) == set(entries)
    assert all("doi = {10." in entry for entry in entries.values() if "journal = " in entry)
    assert re.search(r"^date: \d{1,2} [A-Z][a-z]+ \d{4}$", text, re.MULTILINE)
    assert re.findall(r"^# (.*)$", text, re.MULTILINE) == [
        "Summary", "Statement of need", "State of the field", "Software design", "Research impact statement",
        "AI usage disclosure", "Acknowledgements", "References",
    ]  # fmt: skip
    assert all((DOCS / "paper" / name).is_file() for name in re.findall(r"\]\((\w+\.png)\)", text))
    assert 750 <= len(text.split()) <= 1750
