"""Whatever a user meets stands in the README or in the commented site files."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from station import config, errors
from station.archive.areas import AREA_VARIABLES
from station.archive.variables import VARIABLES
from station.config import read_site, write_site
from station.scanners import SCANNERS
from station.sections import SiteFile

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SITES = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "config").glob("*.toml"))


def commands():
    told = subprocess.run(
        [sys.executable, "-m", "station.cli", "--help"], capture_output=True, text=True, check=True
    ).stdout
    return re.findall(r"^  ([a-z]+)  ", told[told.index("Commands:") :], re.MULTILINE)


def test_every_command():
    found = commands()
    assert {"init", "check", "process", "run", "status", "simulate", "demo"} <= set(found)
    for command in found:
        assert f"`station {command}" in README


def test_every_variable_of_the_store():
    for row in (*VARIABLES, *AREA_VARIABLES):
        assert f"`{row.name}`" in README, row.name


def test_every_error():
    for error in vars(errors).values():
        if isinstance(error, type) and error is not errors.StationError:
            assert f"`{error.__name__}`" in README


def keys(model):
    for name, field in model.model_fields.items():
        inner = [model for model in config._models_in(field.annotation) if issubclass(model, BaseModel)]
        yield field.alias or name
        for section in inner:
            yield from keys(section)


def test_every_key_of_the_site_file():
    optional = {"exit_diameter_m", "registration_sigma_m", "time"}  # overrides for other instruments and logs
    missing = [key for key in set(keys(SiteFile)) - optional if not re.search(rf"\b{key}\b", SITES)]
    assert not missing


@pytest.mark.parametrize("like", ["hef", "mammoth"])
def test_site_files_are_complete(tmp_path, like):
    """Apart from the SOP, which is a station's own."""
    site = write_site(tmp_path, like)
    text = site.read_text(encoding="utf-8")
    for name in re.findall(r'(?:file|pop) = "([^"]+\.dat)"', text):
        (tmp_path / name).write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    told = read_site(site)
    assert told.station.id == like
    with pytest.raises(config.ConfigError, match="nothing is overwritten"):
        write_site(tmp_path, like)


def test_papers_instrument_values():
    """V section 2.2, H Table 1."""
    vz6000 = SCANNERS["riegl-vz-6000"]
    assert (vz6000["wavelength_um"], vz6000["beam_divergence_mrad"]) == (1.064, 0.12)
    assert vz6000["inclination_sigma_deg"] == 0.008
    vz4000 = SCANNERS["riegl-vz-4000"]
    assert (vz4000["wavelength_um"], vz4000["beam_divergence_mrad"], vz4000["exit_diameter_m"]) == (
        1.55, 0.15, 0.018,
    )  # fmt: skip
    z390 = SCANNERS["riegl-lms-z390i"]
    assert (z390["beam_divergence_mrad"], z390["range_sigma_m"]) == (0.30, 0.004)
