"""`requirements.lock`, from which a station PC installs: complete and with checksums."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]


def test_lock_covers_all_dependencies_of_a_station_with_hashes():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (names,) = re.findall(r"\[(.*)\]", extras["all"][0])
    required = [*project["dependencies"], *(text for name in names.split(",") for text in extras[name])]
    entries = re.split(r"\n(?=\S)", (ROOT / "requirements.lock").read_text().strip())
    locked: dict[str, list[str]] = {}
    for entry in entries:
        match = re.match(r"([A-Za-z0-9._-]+)==(\S+)", entry)
        assert match, entry
        assert "--hash=sha256:" in entry, entry
        locked.setdefault(match[1].lower().replace("_", "-"), []).append(match[2])
    for requirement in map(Requirement, required):
        versions = locked[requirement.name.lower().replace("_", "-")]
        assert all(version in requirement.specifier for version in versions), requirement


def test_the_conda_recipe_has_the_dependencies_of_the_project():
    """conda-forge has other names for two of them."""
    names = {"lazrs-python": "lazrs", "python-isal": "isal"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = (ROOT / "systemd/packages/conda/recipe.yaml").read_text()
    assert f'version: "{project["version"]}"' in recipe
    run = recipe.split("  run:\n")[1].split("\n\n")[0]
    lines = [line.split("#")[0].strip(" -") for line in run.splitlines()]
    actual = {names.get(line.split()[0], line.split()[0]): line.split()[1] for line in lines}
    assert actual.pop("python") == ">=${{"
    expected = [Requirement(text) for text in project["dependencies"]]
    assert {name: set(text.split(",")) for name, text in actual.items()} == {
        requirement.name.lower(): set(str(requirement.specifier).split(",")) for requirement in expected
    }
