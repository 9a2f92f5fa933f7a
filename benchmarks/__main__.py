"""What a scan takes against merely decoding it, beside what others take: ratios, in one run.

python -m benchmarks [--points MILLIONS] [--folder DIR] [--quick]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cost import STEPS, Cost, FailedError, cost_of, job_cost, middle
from benchmarks.peers import M3C2, PEERS, Peer, Work, take
from benchmarks.ratios import Row, show
from station.service.child import SURROUNDINGS

ROUNDS = 3  # and scans, of each the median
MUST_PEAK_GB = 0.9
MUST_PEAK_GROWTH = 1.1
MUST_EPOCHS = 1.2
OVER_EPOCHS = "growth over epochs: file, series, areas and page, or all but the file; ratios to the fewest"
FEW_SHARE, MANY_TIMES = 0.1, 4  # of the points: 1.44, 14.4 and 57.6 million
SIZES = (0.25, 0.5, 1.0)  # of the grid: 1,000 x 1,250 to 4,000 x 5,000
QUICK_SIZE, QUICK_POINTS = 0.05, 40_000
ARCHIVED, QUICK_ARCHIVED = (10, 8760), (10, 100)


@dataclass(frozen=True)
class Run:
    """Where the benchmark works, and on how much."""

    folder: Path
    points: int
    quick: bool

    @property
    def size(self) -> float:
        """Length of the grid against the full one."""
        return QUICK_SIZE if self.quick else 1.0

    def own(self, job: str, **told: object) -> tuple[Cost, dict[str, Any]]:
        """Run a job of the station, as its service runs its children."""
        return job_cost("benchmarks.own", job, self.folder, SURROUNDINGS, **told)

    def decode(self, scan: str) -> Cost:
        """Return the floor of a scan."""
        return job_cost("benchmarks.peerwork", "decode", self.folder, scan=scan)[0]


def main() -> None:
    """Measure, and print one table."""
    asked = _arguments()
    with tempfile.TemporaryDirectory() as passing:
        folder = (asked.folder or Path(passing)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        points = QUICK_POINTS if asked.quick else round(asked.points * 1e6)
        show(measured(Run(folder, points, asked.quick)))


@dataclass(frozen=True)
class Data:
    """A station with its reference: site files, a scan of the reference, and the scans that come."""

    site: str
    alone: str  # without adjustment, in a store of its own
    served: str  # with an empty inbox, in another
    before: str
    coming: list[str]


def measured(run: Run) -> list[tuple[str, list[Row]]]:
    """Return the sections of the table."""
    data = _data(run)
    epoch = Row(
        "station, epoch written",
        *_own(run, "epoch", data),
        {"cpu": 1.25, "peak_gb": MUST_PEAK_GB},
        {"cpu": 1.1},
        "adjustment, pictures",
    )
    return [
        (f"{run.points / 1e6:g} million points: ratios to decoding them", _ways(run, data, epoch)),
        ("growth over points: epoch written; ratios to decoding them", _over_points(run, data.alone, epoch)),
        ("growth over cells: epoch written; ratios to the smallest grid", _over_cells(run, data.alone)),
        *_store(run),
    ]


def _data(run: Run) -> Data:
    scans = 1 if run.quick else ROUNDS
    _say("scans")
    _, made = run.own("make", points=run.points, scans=scans, size=run.size, folder=str(run.folder))
    site, of_reference, coming = made["site"], made["scans"][:-scans], made["scans"][-scans:]
    _say("the reference")
    _, alone = run.own("referenced", site=site, scans=of_reference)
    _, served = run.own("served", site=site, alone=alone["site"])
    return Data(site, alone["site"], served["site"], of_reference[0], coming)


def _ways(run: Run, data: Data, epoch: Row) -> list[Row]:
    """Return what the station takes for a scan, and what others take."""
    _say("the service")
    decoded = [run.decode(scan) for scan in data.coming]
    _, served = run.own("serve", site=data.served, scans=data.coming)
    decoded += [run.decode(scan) for scan in data.coming]
    floor, service = middle(decoded), middle([Cost(**one) for one in served["took"]])
    works = [
        Work(**run.own("work", site=data.site, scan=scan, before=data.before)[1]) for scan in data.coming
    ]
    return [
        Row("laspy + lazrs, one thread", floor, floor),
        Row("station, on the grid", *_own(run, "hot", data), note="epoch, adjustment"),
        epoch,
        Row(
            "station, running service", service, floor, {"cpu": 2.0, "wall": 1.6, "peak_gb": MUST_PEAK_GB}
        ),
        Row("its functions, a million points at once", *_own(run, "chunks", data), note="epoch, adjustment"),
        *(_peer(run, peer, works) for peer in PEERS),
    ]  # fmt: skip


def _own(run: Run, job: str, data: Data) -> tuple[Cost, Cost]:
    """Return what a job takes for a scan, and what decoding it takes."""
    _say(job)
    cost, floor = _beside(run, data.coming, lambda scan: run.own(job, site=data.alone, scan=scan)[0])
    _say(f"  {cost.cpu_s:.2f} CPU-s")
    return cost, floor


def _beside(run: Run, scans: list[str], take_it: Callable[[str], Cost]) -> tuple[Cost, Cost]:
    """Return what work on a scan takes, and what decoding takes just before: machines have slower minutes."""
    floors, costs = zip(*((run.decode(scan), take_it(scan)) for scan in scans), strict=True)
    return middle(costs), middle(floors)


def _peer(run: Run, peer: Peer, works: list[Work]) -> Row:
    """Return the row of a peer, also where it is not there or fails."""
    if not peer.is_there:
        return Row(peer.title, None, note="not installed")
    _say(peer.title)
    by_scan = {work.scan: work for work in works}
    try:
        costs = _beside(run, list(by_scan), lambda scan: take(peer, by_scan[scan], run.folder)[0])
    except FailedError as error:
        return Row(peer.title, None, note=f"failed: {error}")
    return Row(peer.title, *costs, note=peer.lacks)


def _over_points(run: Run, site: str, measured: Row) -> list[Row]:
    """Return what fewer and more points than those measured take."""
    taken = {run.points: (measured.cost, measured.base)}
    for points in (round(run.points * FEW_SHARE), run.points * (2 if run.quick else MANY_TIMES)):
        _say(f"{points:,} points")
        _, made = run.own("make", points=points, scans=1, size=run.size, folder=str(run.folder))
        scan = made["scans"][-1]
        taken[points] = run.own("epoch", site=site, scan=scan)[0], run.decode(scan)
    least_gb = min(cost.peak_gb for cost, _ in taken.values() if cost)
    must = {"peak_gb": min(MUST_PEAK_GB, MUST_PEAK_GROWTH * least_gb)}
    return [Row(f"{points / 1e6:g} million", *taken[points], must) for points in sorted(taken)]


def _over_cells(run: Run, full: str) -> list[Row]:
    rows: list[Row] = []
    for share in SIZES:
        size = share * run.size
        _say(f"{4000 * size:,.0f} x {5000 * size:,.0f} cells")
        points = round(run.points * FEW_SHARE)
        _, made = run.own("make", points=points, scans=1, size=size, folder=str(run.folder))
        site = full
        if size != run.size:
            _, alone = run.own("referenced", site=made["site"], scans=made["scans"][:-1])
            site = alone["site"]
        cost, _ = run.own("epoch", site=site, scan=made["scans"][-1])
        base = rows[0].cost if rows else cost
        rows.append(Row(f"{4000 * size:,.0f} x {5000 * size:,.0f}", cost, base))
    return rows


def _over_epochs(found: dict[str, float]) -> list[Row]:
    """Return what the store takes for an epoch, and how much of that comes after its file."""
    rows = []
    for size, grid in (("full", "the full grid"), ("small", "a tiny grid")):
        for steps, what, must in ((STEPS, "epoch", {"cpu": MUST_EPOCHS}), (STEPS[1:], "after epoch", {})):
            few, year = (
                Cost(sum(found[f"{step}_{size}_{word}"] for step in steps)) for word in ("few", "year")
            )
            rows += [
                Row(f"station, {what} 10, {grid}", few, few),
                Row(f"station, {what} 8,760, {grid}", year, few, must),
            ]
    return rows


def _archive(run: Run) -> list[Row]:
    """Return what py4dgeo's archive of epochs takes for one more."""
    title = "py4dgeo's archive, epoch {:,}"
    if not M3C2.is_there:
        return [Row(title.format(ARCHIVED[-1]), None, note="not installed")]
    taken = {}
    for epochs in QUICK_ARCHIVED if run.quick else ARCHIVED:
        _say(title.format(epochs))
        _, told = job_cost("benchmarks.peerwork", "append", run.folder, epochs=epochs)
        taken[epochs] = Cost(told["cpu_s"], told["wall_s"])
    first = next(iter(taken.values()))
    return [Row(title.format(epochs), cost, first, note="500 places") for epochs, cost in taken.items()]


def _store(run: Run) -> list[tuple[str, list[Row]]]:
    """Return the sections of what the store takes."""
    _say("a year of epochs")
    told = [cost_of([sys.executable, "-m", "station.cli", "--help"], run.folder)[0] for _ in range(ROUNDS)]
    starting = [Row("station --help", middle(told), must={"cpu_s": 0.3})]
    if run.quick:
        return [(OVER_EPOCHS, _archive(run)), ("start-up", starting)]
    try:
        _, found = run.own("epochs")
    except FailedError as error:  # a year takes 15 GB; what was measured so far is told all the same
        lost = Row("a year of epochs", None, note=f"failed: {error}")
        return [(OVER_EPOCHS, [lost]), ("start-up", starting)]

    def took(name: str) -> Cost:
        return Cost(found[f"{name}_cpu_s"], found[f"{name}_s"])

    starting += [
        Row(f"station run, {state} files", took(f"ready_{state}"), must={"wall_s": 5.0})
        for state in ("cold", "warm")
    ]
    joined = Cost(found["join_day_cpu_s"], found["join_day_s"], found["join_day_gb"])
    reading = [
        *(
            Row(f"{title}, {state} files", took(f"{name}_{state}"), must={"wall_s": most} if most else {})
            for title, name, most in (
                ("a map opened", "map", 1.0),
                ("a 100 m box, all year", "box_year", 5.0),
                ("the same, without station.open", "box_year_plain", 0.0),
            )
            for state in ("cold", "warm")
        ),
        Row("a day joined", joined, must={"peak_gb": 1.5}),
    ]
    return [(OVER_EPOCHS, _over_epochs(found) + _archive(run)), ("a year stored", reading + starting)]


def _say(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="What a scan takes against decoding it, beside others.")
    parser.add_argument("--points", type=float, default=14.4, help="millions, of a scan")
    parser.add_argument("--folder", type=Path, help="where the data is kept")
    parser.add_argument("--quick", action="store_true", help="a tiny grid: does it run?")
    return parser.parse_args()


if __name__ == "__main__":
    main()
