"""The air of a scan, from the weather log of the station."""

from __future__ import annotations

from datetime import datetime, timedelta

from station.config import Site
from station.errors import NotReadyError, ScanError
from station.quantities import Air
from station.readers.weather import interpolate_air, read_weather
from station.science.geometry.air import standard_air
from station.sections.inputs import WeatherSection

MAX_PRESSURE_DEVIATION_HPA = 60.0  # from the standard atmosphere; weather amounts to 40 hPa


def air_from_log(section: WeatherSection, time_utc_s: float, height_m: float | None) -> Air | None:
    """Return the air at a time, interpolated in the weather log; None if the log has a gap.

    `height_m` is that of the scanner, None if it is unknown. Raises ScanError if the log or its pressure
    cannot be used, NotReadyError if the log cannot be read.
    """
    window_utc_s = time_utc_s - section.max_age_s, time_utc_s + section.max_age_s
    log = read_weather(section, window_utc_s)
    air = interpolate_air(log, time_utc_s, section.max_age_s)
    if air is not None and (message := pressure_fault(air, height_m)):
        raise ScanError(message)
    return air


def pressure_fault(air: Air, height_m: float | None) -> str:
    """Return a message if the pressure cannot be that at a height [m], '' if it can or that is unknown."""
    if height_m is None:
        return ""
    expected_hpa, sea_level_hpa = (standard_air(height).pressure_hpa for height in (height_m, 0.0))
    if abs(air.pressure_hpa - expected_hpa) <= MAX_PRESSURE_DEVIATION_HPA:
        return ""
    message = (
        f"pressure of {air.pressure_hpa:.1f} hPa, but at {height_m:,.0f} m the standard atmosphere has"
        f" {expected_hpa:.0f} hPa: "
    )
    if abs(air.pressure_hpa - sea_level_hpa) <= MAX_PRESSURE_DEVIATION_HPA:
        return message + "it is reduced to sea level; log the pressure at the station itself"
    return message + "wrong column or unit, a failed sensor, or a wrong height of the SOP"


def air_of_scan(site: Site, mid_scan: datetime, height_m: float, warnings: list[str]) -> tuple[Air, bool]:
    """Return the air of the scan, and whether it was measured."""
    if site.weather is not None:
        section = site.weather
        try:
            air = air_from_log(section, mid_scan.timestamp(), None if site.map.crs is None else height_m)
            age = timedelta(seconds=section.max_age_s)
            message = f"weather missing within {age} of {mid_scan:%Y-%m-%d %H:%M} UTC"
        except (ScanError, NotReadyError) as error:  # a scan does not wait for its weather indefinitely
            air, message = None, f"weather unusable: {error}"
        if air is not None:
            return air, True
        warnings.append(message)
    if site.air is None or site.air.scanner_setting == "weather":
        return standard_air(height_m), False
    return site.air.scanner_setting.air, False
