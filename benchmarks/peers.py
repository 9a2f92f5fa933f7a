"""What others use for a map of mean heights, or of change: which there are, and what they lack.

Their work stands in `peerwork`, each in a process of its own.
"""

from __future__ import annotations

import importlib.util
import shutil
from dataclasses import dataclass
from pathlib import Path

from benchmarks.cost import Cost, cost_of, job_cost


@dataclass(frozen=True)
class Peer:
    """Another way to do part of the work: what it needs, and what it lacks of the work."""

    name: str
    title: str
    needs: str  # module or program
    lacks: str
    is_program: bool = False

    @property
    def is_there(self) -> bool:
        """Tell whether it is installed."""
        return bool(shutil.which(self.needs) if self.is_program else importlib.util.find_spec(self.needs))


BARE = "tilt, air, curvature; σ, change"
M3C2 = Peer("m3c2", "py4dgeo M3C2", "py4dgeo", "tilt, air, curvature; shared σ; at 50,000 places only")
PEERS = (
    Peer("scipy", "scipy binned_statistic_2d", "scipy", BARE),
    Peer("datashader", "datashader", "datashader", BARE),
    Peer("pdal", "PDAL", "pdal", BARE, is_program=True),
    Peer("cloudcompare", "CloudCompare", "CloudCompare", f"decoding; {BARE}", is_program=True),
    M3C2,
)


@dataclass(frozen=True)
class Work:
    """What a peer is to do: bring a scan by one matrix (4, 4) onto a grid with its SW corner at 0, 0."""

    scan: str
    before: str  # another scan, for those who make a difference
    matrix: list[list[float]]
    cell_m: float
    nx: int
    ny: int


def take(peer: Peer, work: Work, folder: Path) -> tuple[Cost, dict[str, float]]:
    """Have a peer do its work in a folder; return what it took, and `cells` filled with their `mean_m`."""
    if not peer.is_program:
        return job_cost("benchmarks.peerwork", peer.name, folder, **vars(work))
    _, prepared = job_cost("benchmarks.peerwork", f"{peer.name}_before", folder, **vars(work))
    cost, _ = cost_of(prepared["command"], folder, {"QT_QPA_PLATFORM": "offscreen"})
    _, figures = job_cost("benchmarks.peerwork", f"{peer.name}_after", folder, **vars(work))
    return cost, figures
