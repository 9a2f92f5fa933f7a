"""Make the pictures in docs/images: `python docs/make_pictures.py FOLDER`, with Chromium and matplotlib.

FOLDER gets the stations that they show, or has them already: the demo, and that of the tutorial.
"""

from __future__ import annotations

import importlib.util
import io
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
TUTORIAL = ROOT / "docs" / "tutorial" / "first-change-map.md"
MAX_WIDTH_PX = 1100
DEMO_HOURS, TUTORIAL_HOURS = 24, 10
DRAWN = "document.querySelector('#map-canvas[aria-busy=false]') && document.fonts.status === 'loaded'"
ASKED = "document.querySelectorAll('#asked-curves canvas').length > 0"


@dataclass(frozen=True)
class Picture:
    """What a picture shows: a link into the page, something done there, and what is seen then."""

    size: tuple[int, int]
    link: str = ""
    act: str = ""  # script
    seen: str = DRAWN  # true once it is there
    top: str = "map"  # element at the top
    dark: bool = False


PICTURES = {
    "page": Picture((1100, 1760), "#at=635250,5185200", seen=f"{DRAWN} && {ASKED}", top=""),
    "map": Picture(
        (900, 1500),
        act="[...document.querySelectorAll('tr[data-event] button')].at(-1).click()",
        seen=f"{DRAWN} && {ASKED}",
    ),
    "map-phone": Picture((390, 1080), "#layer=significance", dark=True),
    "map-swipe": Picture(
        (1000, 900),
        "#since=2025-07-15T00:00Z&time=2025-07-15T07:00Z",
        "document.getElementById('show-swipe').click()",
    ),
}


def main() -> None:
    """Make all pictures."""
    folder = Path(sys.argv[1]).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "demo").is_dir():
        _station(folder, "demo", "demo", "--hours", str(DEMO_HOURS))
    page = folder / "demo" / "data" / "page" / "index.html"
    with tempfile.TemporaryDirectory() as profile:
        tab = _browser().Page(shutil.which("chromium"), profile)
        for name, picture in PICTURES.items():
            _save(name, _photograph(tab, page.as_uri(), picture))
        tab.close()
    _tutorial(folder)


def _browser() -> Any:  # noqa: ANN401 - a module
    """Return the module by which the tests drive Chromium."""
    spec = importlib.util.spec_from_file_location("browser", ROOT / "tests" / "products" / "browser.py")
    assert spec is not None and spec.loader is not None  # noqa: PT018 - the file is there
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _photograph(tab: Any, address: str, picture: Picture) -> bytes:  # noqa: ANN401
    """Return a picture of the page as PNG."""
    tab.set_size(*picture.size, dark=picture.dark)
    tab.open("about:blank")  # a link to a place in the page that is open would not load it
    tab.open(address + picture.link)
    tab.await_(DRAWN)
    if picture.act:
        tab.run(picture.act)
    tab.await_(picture.seen)
    tab.run(f"document.getElementById('{picture.top}')?.scrollIntoView()")
    tab.await_(picture.seen)
    image: bytes = tab.screenshot()
    return image


def _tutorial(folder: Path) -> None:
    """Process the station of the tutorial and make its two maps."""
    site = folder / "my-slope" / "site.toml"
    if not site.is_file():
        _station(folder, "simulate", "practice", "--hours", str(TUTORIAL_HOURS))
        shutil.copytree(
            folder / "practice" / "inbox", site.parent / "scans", ignore=shutil.ignore_patterns("*.txt")
        )
        found = re.search(r'```toml title="my-slope/site.toml"\n(.*?)```', TUTORIAL.read_text(), re.DOTALL)
        assert found is not None
        site.write_text(found[1])
    _station(folder, "process", str(site), *map(str, sorted((site.parent / "scans").glob("*.laz"))))
    for name, arguments in (("change", ["--limit", "0.3"]), ("sigma", ["--show", "sigma"])):
        out = folder / f"{name}.webp"
        _station(folder, "plot", str(site), "map", *arguments, "--out", str(out))
        _save(f"first-{name}", out.read_bytes())


def _station(folder: Path, *arguments: str) -> None:
    """Run a command of the station in a folder."""
    subprocess.run([sys.executable, "-m", "station", *arguments], cwd=folder, check=True)  # noqa: S603 - ours


def _save(name: str, image: bytes) -> None:
    with Image.open(io.BytesIO(image)) as opened:
        picture = opened.convert("RGB")
        picture.thumbnail((MAX_WIDTH_PX, picture.height))
        picture.save(IMAGES / f"{name}.webp", quality=85, method=6)


if __name__ == "__main__":
    main()
