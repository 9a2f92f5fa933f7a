"""Rows of the accuracy table: the station of each, and what is required of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Limits = tuple[float, float]


@dataclass(frozen=True)
class Row:
    """A case: a scenario of the simulator, how it is processed, and limits of its figures.

    Without a limit, a figure is printed and not judged.
    """

    name: str
    title: str
    scenario: str
    boxes_must_m: Limits | None = None  # rms and 95 % of the errors of 100 m boxes
    boxes_aim_m: Limits | None = None
    z: Limits | None = (0.8, 1.25)  # standard deviation of standardised errors, at every scale
    z_bands: bool = False  # also in every band of range
    significant: Limits | None = None  # share of unchanged cells flagged as changed
    good: bool = False  # at least 95 % of the verdicts are "good"
    reason: str = ""  # pattern: at least 95 % of the scans have a matching reason
    retained: bool = False  # the share of the change that is retained is .9 to 1.1, or sigma covers the error
    sign: bool = False  # the mean error does not keep its sign beyond chance
    wider: bool = False  # sigma of 100 m boxes is larger than before
    second_half: bool = False  # the event begins at half of the hours: figures are of the scans from then on
    poor: bool = False  # stable ground is a far ridge and a hut, whatever the scenario says
    log: bool = True  # the inclination log is used
    adjustment: Literal["joint", "none"] = "joint"

    @property
    def station(self) -> str:
        """Name of the simulated station; several rows may share one."""
        return f"{self.scenario}{'-poor' if self.poor else ''}"


CALM_M, CALM_AIM_M = (0.015, 0.03), (0.008, 0.016)
POOR_M, POOR_AIM_M = (0.04, 0.08), (0.025, 0.05)
SNOW_M, SNOW_AIM_M = (0.03, 0.06), (0.02, 0.04)
ICE_M, ICE_AIM_M = (0.05, 0.10), (0.03, 0.06)
NO_BRIGHTNESS_M, NO_BRIGHTNESS_AIM_M = (0.10, 0.20), (0.05, 0.10)
SIGNIFICANT = (0.03, 0.07)
LOG_Z = (0.0, 1.25)

ROWS = {
    row.name: row
    for row in (
        Row("calm-fixed", "calm, without the inclination log", "quiet", z=None, log=False, adjustment="none"),
        Row("calm-filtered", "calm, filtered inclination log alone", "quiet", adjustment="none"),
        Row(
            "calm", "calm, rock all round", "quiet", CALM_M, CALM_AIM_M,
            z_bands=True, significant=SIGNIFICANT, good=True,
        ),
        Row("poor", "calm, far ridge and hut", "poor", POOR_M, POOR_AIM_M),
        Row(
            "rough", "rough valley, rock all round", "rough", CALM_M, CALM_AIM_M,
            z_bands=True, significant=SIGNIFICANT, good=True,
        ),
        Row("rough-poor", "rough valley, far ridge and hut", "rough-poor", POOR_M, POOR_AIM_M),
        Row("airborne", "0.1 % of the echoes from the air", "airborne", (0.02, 0.04)),
        Row(
            "airborne-heavy", "1 % of the echoes from the air, and clouds", "airborne-heavy", SNOW_M,
            reason="echo|air",
        ),
        Row("snow", "0.4 m of snow", "snowfall", SNOW_M, SNOW_AIM_M, good=True, second_half=True),
        Row(
            "snow-db", "the same, brightness in dB", "snow-db", SNOW_M, SNOW_AIM_M,
            good=True, second_half=True,
        ),
        Row(
            "snow-1550", "the same at 1550 nm", "snow-1550", SNOW_M, SNOW_AIM_M, good=True, second_half=True,
        ),
        Row(
            "snow-no-brightness", "the same without brightness", "snow-no-brightness",
            NO_BRIGHTNESS_M, NO_BRIGHTNESS_AIM_M,
            z=(0.8, 1.4), reason="no brightness", sign=True, second_half=True,
        ),
        Row("snow-poor", "0.4 m of snow, far ridge and hut", "snowfall", second_half=True, poor=True),
        Row("ice-refraction", "k over ice differs by 0.1", "ice-refraction", ICE_M, ICE_AIM_M, good=True),
        Row(
            "settling", "5 cm of settling ∝ range, far ridge and hut", "settling", retained=True, sign=True,
        ),
        Row(
            "melt-height", "5 cm of melt by height, far ridge and hut", "melt-height",
            retained=True, sign=True,
        ),
        Row("melt", "melt of 5 mm/h, rock all round", "melt", retained=True),
        Row("avalanche", "avalanche of 2 m", "avalanche", CALM_M),
        Row("winter", "2 m of snow between two scans", "winter", ICE_M, good=True),
        Row("summer", "3 m of melt between two scans", "summer", ICE_M, good=True),
        Row("disturbed", "steps, gusts, heavy tails, patchy air", "disturbed", CALM_M),
        Row("breathing", "rock heaves by 3 mm and creeps by 20 mm", "breathing"),
        *(
            Row(
                f"log-{fault}", title, f"log-{fault}",
                z=LOG_Z, reason="log", wider=fault != "time", second_half=True,
            )
            for fault, title in (
                ("cut", "inclination log ends early"),
                ("missing", "inclination log missing"),
                ("time", "one wrong time in the log"),
                ("swapped", "axes of the log swapped"),
            )
        ),
    )
}  # fmt: skip
