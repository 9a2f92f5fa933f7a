"""Descriptions of the series for data servers: NcML for THREDDS, a dataset for ERDDAP."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import netCDF4

from station.archive.discovery import descriptive_attributes, extent
from station.archive.epochs import epochs_in_file
from station.archive.netcdf_layout import CONVENTIONS, Series
from station.archive.read_errors import read_errors
from station.archive.schema import BY_NAME
from station.archive.series.epoch_reader import contiguous_runs
from station.errors import StationError
from station.products.exports.contents import Advance
from station.products.exports.selection import Part, Selection, require_whole_grid
from station.products.gallery import replace_if_changed

NCML = "http://www.unidata.ucar.edu/namespaces/netcdf/ncml-2.2"
ERDDAP_TYPES = {"f4": "float", "f8": "double", "i1": "byte", "i2": "short", "i4": "int"}
RELOAD_MINUTES = 60  # by which ERDDAP looks for changed files, at most


def recognise_ncml(path: Path) -> str | None:
    """Return '' if a file is NcML, which is written again, otherwise None."""
    return _recognise(path, f"{{{NCML}}}netcdf")


def recognise_erddap(path: Path) -> str | None:
    """Return '' if a file is a single dataset of ERDDAP, which is written again, otherwise None."""
    return _recognise(path, "dataset")


def _recognise(path: Path, tag: str) -> str | None:
    try:
        return "" if ET.parse(path).getroot().tag == tag else None  # noqa: S314 - of this machine
    except (OSError, ET.ParseError):
        return None


def write_ncml(
    selection: Selection,
    parts: list[Part],
    _verify: Callable[[Path], None],
    advance: Advance,
) -> Iterator[Path]:
    """Write NcML that joins the files of each part along time, with paths relative to it; yield the paths.

    Variables that some of the files lack, of older versions, are left out: netCDF-Java serves them as zero.
    Raises StationError while a late scan or a revision lies within the time of another file.
    """
    require_whole_grid(selection)
    for part in parts:
        _write(_ncml(selection, part), part.path)
        advance(len(part.epochs))
        yield part.path


def _ncml(selection: Selection, part: Part) -> ET.Element:
    root = ET.Element("netcdf", xmlns=NCML)
    for name, value in _global_attributes(selection.series).items():
        kind = "String" if isinstance(value, str) else "double"
        ET.SubElement(root, "attribute", name=name, type=kind, value=str(value))
    runs = list(contiguous_runs(part.epochs))
    for name in _differing_variables({source for source, *_ in runs}):
        ET.SubElement(root, "remove", name=name, type="variable")
    joined = ET.SubElement(root, "aggregation", dimName="time", type="joinExisting")
    for source, _, _, count in runs:
        if len(epochs_in_file(source)) != count:
            raise StationError(
                f"{source}: only a part of its epochs is valid or within the span: try again after the next"
                " compaction, or without --from and --to"
            )
        location = os.path.relpath(source.resolve(), part.path.parent.resolve())
        ET.SubElement(joined, "netcdf", location=location, ncoords=str(count))
    return root


def _differing_variables(paths: Collection[Path]) -> list[str]:
    """Return the names of variables that not all files have with the same dimensions."""
    shapes: list[set[tuple[str, tuple[int, ...]]]] = []
    for path in paths:
        with read_errors(path), netCDF4.Dataset(path) as file:
            shapes.append({(name, variable.shape[1:]) for name, variable in file.variables.items()})
    return sorted({name for name, _ in shapes[0].union(*shapes) - shapes[0].intersection(*shapes)})


def write_erddap(
    selection: Selection,
    parts: list[Part],
    _verify: Callable[[Path], None],
    advance: Advance,
) -> Iterator[Path]:
    """Write a dataset for `datasets.xml` of ERDDAP: the monthly or daily NetCDF exports beside it."""
    for part in parts:
        _write(_erddap(selection, part.path.parent.resolve()), part.path)
        advance(len(part.epochs))
        yield part.path


def _erddap(selection: Selection, folder: Path) -> ET.Element:
    series = selection.series
    root = ET.Element("dataset", type="EDDGridFromNcFiles", datasetID=series.station_id, active="true")
    for name, text in {
        "reloadEveryNMinutes": str(RELOAD_MINUTES),
        "updateEveryNMillis": "10000",
        "fileDir": f"{folder}/",
        "fileNameRegex": rf"{series.station_id}_\d{{6,8}}\.nc",
        "recursive": "false",
        "pathRegex": ".*",
        "metadataFrom": "last",
        "matchAxisNDigits": "20",
        "fileTableInMemory": "false",
    }.items():
        ET.SubElement(root, name).text = text
    _add_attributes(root, {"infoUrl": "???", "sourceUrl": "(local files)", **_global_attributes(series)})
    for axis, category in (("time", "Time"), ("y", "Location"), ("x", "Location")):
        _add_variable(root, "axisVariable", axis, "double", {"ioos_category": category})
    for name in sorted(selection.variables):
        if (spec := BY_NAME[name]).is_raster:
            attrs: dict[str, str | float] = {
                "ioos_category": "Quality" if spec.flag_meanings else "Other",
                "long_name": spec.long_name,
            }
            _add_variable(root, "dataVariable", name, ERDDAP_TYPES[spec.dtype], attrs)
    return root


def _global_attributes(series: Series) -> dict[str, str | float]:
    name = series.name or series.station_id
    described = descriptive_attributes(name, series.institution, dict(series.metadata))
    if "metadata_link" in described:
        described["infoUrl"] = described["metadata_link"]
    return {
        "Conventions": CONVENTIONS,
        "title": f"Elevation change at {name}",
        **{key: text for key, text in described.items() if key not in {"date_created", "history"}},
        **extent(series.grid, series.crs),
    }


def _add_variable(root: ET.Element, tag: str, name: str, kind: str, attrs: dict[str, str | float]) -> None:
    variable = ET.SubElement(root, tag)
    ET.SubElement(variable, "sourceName").text = name
    ET.SubElement(variable, "destinationName").text = name
    if tag == "dataVariable":
        ET.SubElement(variable, "dataType").text = kind
    _add_attributes(variable, attrs)


def _add_attributes(element: ET.Element, attrs: dict[str, str | float]) -> None:
    added = ET.SubElement(element, "addAttributes")
    for name, value in attrs.items():
        att = ET.SubElement(added, "att", name=name)
        att.text = str(value)
        if not isinstance(value, str):
            att.set("type", "double")


def _write(root: ET.Element, path: Path) -> None:
    ET.indent(root)
    replace_if_changed(path, ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
