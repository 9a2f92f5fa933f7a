"""Cost of a scan relative to decoding it, for the station and for other programs, measured in one run.

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

from benchmarks.peers import M3C2, PEERS, GridTask, Peer, peer_cost
from benchmarks.process_cost import Cost, FailedError, Row, cost_of, job_cost, median_cost, print_rows
from station.processing.workers.fork_server import WORKER_ENV

ROUNDS = 3  # scans, and start-ups: the median of each is taken
PEAK_LIMIT_GB = 0.9
PEAK_GROWTH_LIMIT = 1.1
EPOCH_GROWTH_LIMIT = 1.2
EPOCH_SECTION = "growth over epochs: file, series, areas and page, or all but the file; ratios to the fewest"
STEPS = ("write_s", "update_s", "publish_s")  # of storing an epoch
FEW_POINTS, MANY_POINTS = 0.1, 4  # relative to a typical scan: 1.44, 14.4 and 57.6 million
GRID_SIZES = (0.25, 0.5, 1.0)  # relative to the full grid: 1,000 x 1,250 to 4,000 x 5,000
QUICK_SIZE, QUICK_POINTS = 0.05, 40_000
ARCHIVE_EPOCHS, QUICK_ARCHIVE_EPOCHS = (10, 8760), (10, 100)

Sections = list[tuple[str, list[Row]]]


@dataclass(frozen=True)
class Run:
    """Folder and size of a run."""

    folder: Path
    points: int
    quick: bool

    @property
    def size(self) -> float:
        """Length of the grid relative to the full one."""
        return QUICK_SIZE if self.quick else 1.0

    def station_job(self, job: str, **arguments: object) -> tuple[Cost, dict[str, Any]]:
        """Run a job of the station in the environment of the service's worker processes."""
        return job_cost("benchmarks.station_jobs", job, self.folder, WORKER_ENV, **arguments)

    def make(
        self, points: int, scans: int = 1, size: float | None = None
    ) -> tuple[str, list[str], list[str]]:
        """Simulate a station; return its site file, the scans of its reference, and `scans` further scans."""
        size = self.size if size is None else size
        _, made = self.station_job("make", points=points, scans=scans, size=size, folder=str(self.folder))
        return made["site"], made["scans"][:-scans], made["scans"][-scans:]

    def decode(self, scan: str) -> Cost:
        """Return the cost of decoding a scan."""
        return job_cost("benchmarks.peers", "decode", self.folder, scan=scan)[0]

    def cost_and_decoding(self, scans: list[str], work: Callable[[str], Cost]) -> tuple[Cost, Cost]:
        """Return the cost of work on a scan, and of decoding just before: the speed of machines varies."""
        decoding, costs = zip(*((self.decode(scan), work(scan)) for scan in scans), strict=True)
        return median_cost(costs), median_cost(decoding)


@dataclass(frozen=True)
class Data:
    """A simulated station: site files, a scan of the reference, and the scans to process."""

    site: str
    unadjusted_site: str  # without adjustment, with its own store
    service_site: str  # with an empty inbox and its own store
    reference_scan: str
    scans: list[str]


def main() -> None:
    """Measure, and print one table."""
    arguments = _arguments()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.folder or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        points = QUICK_POINTS if arguments.quick else round(arguments.points * 1e6)
        print_rows(measure(Run(folder, points, arguments.quick)))


def measure(run: Run) -> Sections:
    """Return the sections of the table."""
    data = _make_data(run)
    epoch = Row(
        "station, epoch written",
        *_station_cost(run, "epoch", data),
        {"cpu": 1.25, "peak_gb": PEAK_LIMIT_GB},
        {"cpu": 1.1},
        "adjustment, pictures",
    )
    return [
        (f"{run.points / 1e6:g} million points: ratios to decoding them", _programs(run, data, epoch)),
        (
            "growth over points: epoch written; ratios to decoding them",
            _over_points(run, data.unadjusted_site, epoch),
        ),
        (
            "growth over cells: epoch written; ratios to the smallest grid",
            _over_cells(run, data.unadjusted_site),
        ),
        *_store(run),
    ]


def _make_data(run: Run) -> Data:
    _log("scans")
    site, reference_scans, scans = run.make(run.points, 1 if run.quick else ROUNDS)
    _log("reference")
    _, unadjusted = run.station_job("unadjusted", site=site, scans=reference_scans)
    _, service = run.station_job("service_site", site=site, referenced=unadjusted["site"])
    return Data(site, unadjusted["site"], service["site"], reference_scans[0], scans)


def _programs(run: Run, data: Data, epoch: Row) -> list[Row]:
    """Return the cost of a scan for the station and for other programs."""
    _log("service")
    decoding = [run.decode(scan) for scan in data.scans]
    _, result = run.station_job("service", site=data.service_site, scans=data.scans)
    decoding += [run.decode(scan) for scan in data.scans]
    baseline, service = median_cost(decoding), median_cost([Cost(**cost) for cost in result["costs"]])
    _log("page")
    history, hours = (3, 2) if run.quick else (49, 24)
    scan = data.scans[0]
    _, page = run.station_job("page", site=data.service_site, scan=scan, history=history, hours=hours)
    _, kept = run.station_job("page_year", site=data.service_site, days=1 if run.quick else 365)
    tasks = [
        run.station_job("grid_task", site=data.site, scan=scan, earlier_scan=data.reference_scan)[1]
        for scan in data.scans
    ]
    limits = {"cpu": 2.0, "wall": 1.6, "peak_gb": PEAK_LIMIT_GB}
    million = _station_cost(run, "large_blocks", data)
    return [
        Row("laspy + lazrs, one thread", baseline, baseline),
        Row("station, on the grid", *_station_cost(run, "gridding", data), note="epoch, adjustment"),
        epoch,
        Row("station, running service", service, baseline, limits),
        Row("station, page alone, mean of a day", Cost(page["page_s"]), Cost(page["decode_s"]), {"cpu": 0.3}),
        Row("its folder after a year", Cost(0.0, disk_gb=kept["disk_gb"]), limits={"disk_gb": 1.5}),
        Row("its functions, a million points at once", *million, note="epoch, adjustment"),
        *(_peer(run, peer, {task["scan"]: GridTask(**task) for task in tasks}) for peer in PEERS),
    ]


def _station_cost(run: Run, job: str, data: Data) -> tuple[Cost, Cost]:
    """Return the cost of a job of the station for a scan, and of decoding it."""
    _log(job)
    cost, decoding = run.cost_and_decoding(
        data.scans, lambda scan: run.station_job(job, site=data.unadjusted_site, scan=scan)[0]
    )
    _log(f"  {cost.cpu_s:.2f} CPU-s")
    return cost, decoding


def _peer(run: Run, peer: Peer, tasks: dict[str, GridTask]) -> Row:
    """Return the row of another program, also if it is not installed or fails."""
    if not peer.is_installed:
        return Row(peer.title, None, note="not installed")
    _log(peer.title)
    try:
        costs = run.cost_and_decoding(list(tasks), lambda scan: peer_cost(peer, tasks[scan], run.folder)[0])
    except FailedError as error:
        return Row(peer.title, None, note=f"failed: {error}")
    return Row(peer.title, *costs, note=peer.omits)


def _over_points(run: Run, site: str, measured: Row) -> list[Row]:
    """Return the cost of an epoch for fewer and more points."""
    costs = {run.points: (measured.cost, measured.base)}
    for points in (round(run.points * FEW_POINTS), run.points * (2 if run.quick else MANY_POINTS)):
        _log(f"{points:,} points")
        _, _, (scan,) = run.make(points)
        costs[points] = run.station_job("epoch", site=site, scan=scan)[0], run.decode(scan)
    least_gb = min(cost.peak_gb for cost, _ in costs.values() if cost)
    limits = {"peak_gb": min(PEAK_LIMIT_GB, PEAK_GROWTH_LIMIT * least_gb)}
    return [Row(f"{points / 1e6:g} million", *costs[points], limits) for points in sorted(costs)]


def _over_cells(run: Run, full_site: str) -> list[Row]:
    """Return the cost of an epoch by the size of the grid."""
    rows: list[Row] = []
    for share in GRID_SIZES:
        size, site = share * run.size, full_site
        title = f"{4000 * size:,.0f} x {5000 * size:,.0f}"
        _log(f"{title} cells")
        made, reference_scans, (scan,) = run.make(round(run.points * FEW_POINTS), size=size)
        if size != run.size:
            site = run.station_job("unadjusted", site=made, scans=reference_scans)[1]["site"]
        cost, _ = run.station_job("epoch", site=site, scan=scan)
        rows.append(Row(title, cost, rows[0].cost if rows else cost))
    return rows


def _over_epochs(figures: dict[str, float]) -> list[Row]:
    """Return the cost of an epoch in a store of few and of a year's epochs, with and without its file."""
    rows = []
    for size, grid in (("full", "the full grid"), ("small", "a tiny grid")):
        for steps, what, limits in (
            (STEPS, "epoch", {"cpu": EPOCH_GROWTH_LIMIT}),
            (STEPS[1:], "after epoch", {}),
        ):
            few, year = (
                Cost(sum(figures[f"{step}_{size}_{count}"] for step in steps)) for count in ("few", "year")
            )
            rows += [
                Row(f"station, {what} 10, {grid}", few, few),
                Row(f"station, {what} 8,760, {grid}", year, few, limits),
            ]
    return rows


def _archive(run: Run) -> list[Row]:
    """Return the cost of one more epoch in py4dgeo's archive."""
    title = "py4dgeo's archive, epoch {:,}"
    if not M3C2.is_installed:
        return [Row(title.format(ARCHIVE_EPOCHS[-1]), None, note="not installed")]
    rows: list[Row] = []
    for epochs in QUICK_ARCHIVE_EPOCHS if run.quick else ARCHIVE_EPOCHS:
        _log(title.format(epochs))
        cost = Cost(**job_cost("benchmarks.peers", "append", run.folder, epochs=epochs)[1])
        rows.append(Row(title.format(epochs), cost, rows[0].cost if rows else cost, note="500 places"))
    return rows


def _store(run: Run) -> Sections:
    """Return the sections about the store and the start of the service."""
    _log("a year of epochs")
    help_costs = [cost_of([sys.executable, "-m", "station", "--help"], run.folder)[0] for _ in range(ROUNDS)]
    start_up = [Row("station --help", median_cost(help_costs), limits={"cpu_s": 0.3})]
    if run.quick:
        return [(EPOCH_SECTION, _archive(run)), ("start-up", start_up)]
    try:
        _, figures = run.station_job("year")
    except FailedError as error:  # a year takes 15 GB; the figures so far are printed nevertheless
        failed = Row("a year of epochs", None, note=f"failed: {error}")
        return [(EPOCH_SECTION, [failed]), ("start-up", start_up)]

    def row(title: str, name: str, limits: dict[str, float]) -> Row:
        cost = Cost(figures[f"{name}_cpu_s"], figures[f"{name}_s"], figures.get(f"{name}_gb", 0.0))
        return Row(title, cost, limits=limits)

    rows = [
        row(f"{title}, {state} files", f"{name}_{state}", {"wall_s": limit_s} if limit_s else {})
        for title, name, limit_s in (
            ("a map opened", "map", 1.0),
            ("a 100 m box, all year", "box_year", 5.0),
            ("station run", "ready", 5.0),
        )
        for state in ("cold", "warm")
    ]
    rows.append(row("a day compacted", "compact_day", {"peak_gb": 1.5}))
    return [(EPOCH_SECTION, _over_epochs(figures) + _archive(run)), ("a year stored", rows + start_up)]


def _log(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Cost of a scan relative to decoding it.")
    parser.add_argument("--points", type=float, default=14.4, help="millions per scan")
    parser.add_argument("--folder", type=Path, help="folder that keeps the data")
    parser.add_argument("--quick", action="store_true", help="a tiny grid, to try it")
    return parser.parse_args()


if __name__ == "__main__":
    main()
