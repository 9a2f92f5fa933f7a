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

from benchmarks.cost import Cost, FailedError, cost_of, job_cost, middle
from benchmarks.peers import M3C2, PEERS, Peer, Work, take
from benchmarks.ratios import Row, show

ROUNDS = 3  # and scans, of each the median
MUST_EPOCH, AIM_EPOCH = {"cpu": 1.25}, {"cpu": 1.1}
MUST_SERVED = {"cpu": 2.0, "wall": 1.6}
MUST_PEAK_GB = 0.9
MUST_PEAK_GROWTH = 1.1
MUST_EPOCHS = 1.2
MUST_HELP_S, MUST_READY_S = 0.3, 5.0
FEW_SHARE, MANY_TIMES = 0.1, 4  # of the points: 1.44, 14.4 and 57.6 million
SIZES = (0.25, 0.5, 1.0)  # of the grid: 1,000 x 1,250 to 4,000 x 5,000
QUICK_SIZE, QUICK_POINTS = 0.05, 40_000
YEAR = Path("epochs/year/site.toml")  # that `own.epochs` leaves
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
        """Run a job of the station."""
        return job_cost("benchmarks.own", job, self.folder, **told)

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


def measured(run: Run) -> list[tuple[str, list[Row]]]:
    """Return the sections of the table."""
    rounds = 1 if run.quick else ROUNDS
    _say("data")
    _, made = run.own("make", points=run.points, scans=rounds, size=run.size, folder=str(run.folder))
    scans = made["scans"]
    of_reference, coming = scans[:-rounds], scans[-rounds:]
    floor = middle([run.decode(scan) for scan in coming])
    _say("the reference")
    _, alone = run.own("referenced", site=made["site"], scans=of_reference)
    _, served = run.own("served", site=made["site"], alone=alone["site"])
    _say("the service")
    _, told = run.own("serve", site=served["site"], scans=coming)
    service = middle([Cost(**one) for one in told["took"]])
    epoch = Row(
        "station, epoch written",
        _own(run, "epoch", alone["site"], coming),
        floor,
        MUST_EPOCH | {"peak_gb": MUST_PEAK_GB},
        AIM_EPOCH,
        "adjustment, pictures",
    )
    station = [
        Row("laspy + lazrs, one thread", floor, floor),
        Row("station, on the grid", _own(run, "hot", alone["site"], coming), floor, note="epoch, adjustment"),
        epoch,
        Row("station, running service", service, floor, MUST_SERVED | {"peak_gb": MUST_PEAK_GB}),
        Row("its functions, a million points at once", _own(run, "chunks", alone["site"], coming), floor,
            note="epoch, adjustment"),
    ]  # fmt: skip
    told = [run.own("work", site=made["site"], scan=scan, before=of_reference[0])[1] for scan in coming]
    peers = [_peer(run, peer, [Work(**one) for one in told], floor) for peer in PEERS]
    site = alone["site"]
    return [
        (f"{run.points / 1e6:g} million points: ratios to decoding them", station + peers),
        ("growth over points: epoch written; ratios to decoding them", _kept(_over_points, run, site, epoch)),
        ("growth over cells: epoch written; ratios to the smallest grid", _kept(_over_cells, run, site)),
        ("growth over epochs: what follows an epoch; ratios to the fewest", _kept(_over_epochs, run)),
        ("start-up", _kept(_startup, run)),
    ]


def _kept(section: Callable[..., list[Row]], *told: object) -> list[Row]:
    """Return the rows of a section; where one fails that, so that the others are not lost."""
    try:
        return section(*told)
    except FailedError as error:
        return [Row("failed", None, note=str(error))]


def _own(run: Run, job: str, site: str, scans: list[str]) -> Cost:
    _say(job)
    return middle([run.own(job, site=site, scan=scan)[0] for scan in scans])


def _peer(run: Run, peer: Peer, works: list[Work], floor: Cost) -> Row:
    """Return the row of a peer, also where it is not there or fails."""
    if not peer.is_there:
        return Row(peer.title, None, note="not installed")
    _say(peer.title)
    try:
        costs = [take(peer, work, run.folder)[0] for work in works]
    except FailedError as error:
        return Row(peer.title, None, note=f"failed: {error}")
    return Row(peer.title, middle(costs), floor, note=peer.lacks)


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


def _over_epochs(run: Run) -> list[Row]:
    few, many = QUICK_ARCHIVED if run.quick else ARCHIVED
    rows = []
    if not run.quick:
        _say(f"{many:,} epochs")
        _, found = run.own("epochs")
        costs = [Cost(found[word]) for word in ("few", "year")]
        rows = [
            Row(f"station, epoch {few}", costs[0], costs[0]),
            Row(f"station, epoch {many:,}", costs[1], costs[0], {"cpu": MUST_EPOCHS}),
        ]
    archive = "py4dgeo, appending to {:,} in its archive"
    if not M3C2.is_there:
        return [*rows, Row(archive.format(many), None, note="not installed")]
    appended = []
    for epochs in (few, many):
        _say(archive.format(epochs))
        _, told = job_cost("benchmarks.peerwork", "append", run.folder, epochs=epochs)
        appended.append(Cost(told["cpu_s"], told["wall_s"]))
    note = "500 places; rewrites what it holds"
    return rows + [
        Row(archive.format(epochs), cost, appended[0], note=note)
        for epochs, cost in zip((few, many), appended, strict=True)
    ]


def _startup(run: Run) -> list[Row]:
    _say("start-up")
    told = [cost_of([sys.executable, "-m", "station.cli", "--help"], run.folder)[0] for _ in range(ROUNDS)]
    rows = [Row("station --help", middle(told), must={"cpu_s": MUST_HELP_S})]
    year = run.folder / YEAR
    if year.exists():
        _, started = run.own("start", site=str(year))
        rows.append(Row("station run, a year stored", Cost(**started), must={"wall_s": MUST_READY_S}))
    return rows


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
