"""The table [weather] of a proposed site file."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from station.errors import StationError
from station.operations.proposals.weather_columns import FoundColumns, find_columns
from station.readers.weather import read_weather
from station.sections.inputs import WeatherSection

NAMELESS = ("toa5", "csv")  # dialects whose columns have no usual names
ZONELESS = ("toa5", "csv", "davis", "lufft")  # whose times are those of the logger's clock
# Formats of times that cannot be mistaken: with a slash, day or month may be first.
TIME_FORMATS = ("%d.%m.%Y %H:%M:%S", "%d.%m.%Y %H:%M", "%Y/%m/%d %H:%M:%S", "%Y/%m/%d %H:%M")
DAY_S = 86_400
TRIED_BYTES = 1 << 18  # of the beginning of a log
UNKNOWN = "…"


def weather_lines(path: Path, dialect: str) -> list[str]:
    """Return the lines of [weather] for a log; comments if its columns or times leave a doubt."""
    lines = ["[weather]", f"file = {_quoted(path.resolve())}", f'format = "{dialect}"']
    zone = ['zone = "UTC"   # check: of the logger'] if dialect in ZONELESS else []
    if dialect == "davis":  # day or month first, as the computer was set
        return [*lines, 'time_format = "%d/%m/%y %H:%M"   # check: as in the file', *zone]
    if dialect not in NAMELESS:
        return [*lines, *zone]
    with path.open("rb") as file:
        found = find_columns(file, dialect)
    note = "# check, also the units: °C, hPa and % where the file states none"
    lines += [f"columns = {_inline(found, dialect)}   {note}", *zone]
    settings: dict[str, Any] = {"format": dialect, "columns": _columns(found, dialect)}
    if found.is_certain and (time_format := _readable_format(path, settings)) is not None:
        return [*lines, *([f'time_format = "{time_format}"'] if time_format else [])]
    doubts = [
        f"{key}: {' or '.join(names)}" for key, names in found.quantities.items() if len(names) > 1
    ] or (["check times (time_format) and units"] if found.is_certain else [])
    return [f"# {line}" for line in (*lines, *doubts)]


def _columns(found: FoundColumns, dialect: str) -> dict[str, str | tuple[str, ...]]:
    """Return `weather.columns`, with an ellipsis for those in doubt."""
    time = {} if dialect == "toa5" else {"time": found.time if len(found.time) != 1 else found.time[0]}
    quantities = {key: names[0] if len(names) == 1 else UNKNOWN for key, names in found.quantities.items()}
    return {key: value or UNKNOWN for key, value in (time | quantities).items()}


def _inline(found: FoundColumns, dialect: str) -> str:
    pairs = (f"{key} = {_quoted(value)}" for key, value in _columns(found, dialect).items())
    return f"{{ {', '.join(pairs)} }}"


def _readable_format(path: Path, settings: dict[str, Any]) -> str | None:
    """Return the format of the times with which the beginning of a log can be read; '' for ISO 8601."""
    with tempfile.TemporaryDirectory() as folder, path.open("rb") as file:
        beginning = Path(folder) / "log"
        beginning.write_bytes(file.read(TRIED_BYTES))
        for time_format in ("", *TIME_FORMATS):
            section = WeatherSection.model_validate(
                settings | {"file": beginning, "time_format": time_format or None}
            )
            try:
                if (read_weather(section).time_utc_s % DAY_S).any():  # not merely dates
                    return time_format
            except StationError:
                continue
    return None


def _quoted(value: str | Path | tuple[str, ...]) -> str:
    """Return a text, or several, as TOML has them."""
    return json.dumps(value if isinstance(value, tuple) else str(value), ensure_ascii=False)
