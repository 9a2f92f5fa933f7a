"""False alarms of events in thousands of quiet hours, on stations with a narrow view.

python -m benchmarks.quiet_hours [--stations N] [--first SEED] [--folder DIR] [--markdown PAGE]

A sector of 12°, over a valley with all disturbances at once, at 0.56 of the real scanner's points: some 6,500
blocks of 10 m, from 150 m to 2.7 km. Every scan is simulated, processed and searched as by the service, with
the threshold of this grid. Stations with an even seed have smooth rock, the others rough rock. Stations that
the folder contains from an earlier run are only searched again.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks import event_stations  # isort: skip - sets the number of BLAS threads before numpy loads
from benchmarks.markdown_tables import write_tables
from station.simulation.scenario import ROUGH, Scenario, full_resolution, named

HOURS = 217  # of which 200 are searched
AZIMUTH_DEG = (160.0, 172.0)  # to the north
EXTENT_M = (-300.0, 300.0, 150.0, 2650.0)
THINNING = 0.75  # of the real scanner's lines, and of the shots of a line


def scenario_of(seed: int) -> Scenario:
    """Return a station with tilt that wanders and jumps, gusts, heavy tails, and air that differs by place.

    Air over ice differs from scan to scan, rock heaves by 3 mm, and 0.1 % of the echoes are from the air.
    """
    full = full_resolution(named("disturbed", HOURS, seed))
    share = (AZIMUTH_DEG[1] - AZIMUTH_DEG[0]) / (full.azimuth_deg[1] - full.azimuth_deg[0])
    scenario = replace(
        full,
        azimuth_deg=AZIMUTH_DEG,
        lines=round(full.lines * share * THINNING),
        shots_per_line=round(full.shots_per_line * THINNING),
        extent_m=EXTENT_M,
        refraction_ice_sigma=0.1,
        airborne_share=0.001,
        heave_m=0.003,
    )
    return replace(scenario, **ROUGH) if seed % 2 else scenario


def score_of(home: Path, seed: int) -> event_stations.Score:
    """Return the score of a station; its scans are deleted once they are processed."""
    scenario, score = scenario_of(seed), event_stations.Score()
    event_stations.score(score, event_stations.events_of(home, scenario), scenario)
    for scan in (home / "inbox").iterdir():
        scan.unlink()
    score.largest_z = event_stations.largest_z(home)
    return score


def main() -> None:
    """Print a row for each station, and a line for each event."""
    parser = argparse.ArgumentParser(description="False alarms of events in quiet hours.")
    parser.add_argument(
        "--stations", type=int, default=10, help="number of stations, 200 searched scans each"
    )
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--folder", type=Path, help="folder that keeps the processed stations")
    parser.add_argument("--markdown", type=Path, help="page of the docs whose table is replaced")
    options = parser.parse_args()
    scores = {"rough rock": event_stations.Score(), "smooth rock": event_stations.Score()}
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(options.first, options.first + options.stations):
            score = score_of((options.folder or Path(temporary)) / f"quiet-{seed}", seed)
            scores["rough rock" if seed % 2 else "smooth rock"] += score
            print(f"{seed}: {'; '.join(score.cells(quiet=True))}", flush=True)
    rows = scores | {"all": sum(scores.values(), event_stations.Score())}
    table = event_stations.QUIET_HEADS, [(name, *its.cells(quiet=True)) for name, its in rows.items()]
    if options.markdown:
        last = options.first + options.stations - 1
        title = f"{HOURS} scans of each station, seeds {options.first} to {last}"
        write_tables(options.markdown, "quiet_hours", title, [table])


if __name__ == "__main__":
    main()
