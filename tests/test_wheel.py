"""The wheel, built from the source distribution, works without the source tree."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Return the wheel; `build` makes the source distribution first, and the wheel from that."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder, ROOT], check=True, capture_output=True)
    assert len(list(folder.glob("tls_station-*.tar.gz"))) == 1
    (path,) = folder.glob("tls_station-*-py3-none-any.whl")
    return path


def test_the_wheel_has_every_file_of_the_package(wheel):
    source = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "station").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    source |= {f"station/sites/{path.name}" for path in (ROOT / "config").iterdir()}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if not name.startswith("tls_station-")}
    assert packed == source


def test_the_program_runs_from_the_wheel_alone(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}

    def run(*command):
        result = subprocess.run(
            [sys.executable, "-P", *command], cwd=tmp_path, env=environment, capture_output=True, text=True,
            check=True,
        )  # fmt: skip
        return result.stdout.strip()

    where = run("-c", "import station; print(station.__file__)")
    assert Path(where).is_relative_to(tmp_path / "installed")
    assert run("-m", "station", "--version") in wheel.name
    assert run("-m", "station", "init", "site", "--like", "mammoth") == "site/site.toml"
    run("-m", "station", "simulate", "small", "--help")
