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
