"""The surface that a product counts from as the mean of the scans in a time span, with its errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Bools, Floats, SharedParameters
from station.queries.aggregates import Aggregates
from station.queries.common_errors import common_error_covariance
from station.queries.epoch_cells import EpochCells, EpochMean, observed_in_all
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S


class SurfaceScans:
    """Scans whose mean is a surface, at some cells (ny, nx).

    All have the reference, the kind of adjustment and the parameters of the last one; others are left out.
    """

    def __init__(self, aggregates: Aggregates, epochs: list[EpochRef], cells: Bools) -> None:
        self._aggregates, self._cells = aggregates, cells
        kind = _kind(aggregates.read_shared(epochs[-1]))
        self._scans = [scan for scan in map(aggregates.read_shared, epochs) if _kind(scan) == kind]
        self._parameters: tuple[SharedParameters, SharedParameters] | None = None  # of the mean of all
        self._last: tuple[EpochRef, EpochRef | EpochMean] | None = None  # places of an epoch share it
        self._seen = np.zeros((len(self._scans), np.count_nonzero(cells)), np.bool_)  # (k, n)
        self._sums = np.zeros((2, self._seen.shape[1]))  # of change [m] and random variance [m²]
        for number, scan in enumerate(self._scans):
            values = self._values(scan.epoch)
            self._seen[number] = np.isfinite(values[0])
            self._sums += np.nan_to_num(values)

    def _values(self, epoch: EpochRef) -> Floats:
        """Return change [m] and its own random variance [m²] in an epoch (2, n), NaN where not observed."""
        scan = self._aggregates.read_cells(epoch, self._cells)
        reference_m2 = scan.reference.random_variance_m2[self._cells]
        own_m2 = np.maximum(scan.random_m**2 - reference_m2, 0.0)
        return np.where(observed_in_all([scan], self._cells)[self._cells], (scan.change_m, own_m2), np.nan)

    def share_of_others(self, epoch: EpochRef, other: EpochRef | EpochMean, cells: Bools) -> Floats | float:
        """Return the factor (n,) of the change from `others` to an epoch that gives that from all scans.

        It is below one for a scan of the surface: at cells (ny, nx), its own share in the mean is left out.
        """
        if epoch == other:
            return 0.0
        if all(scan.epoch != epoch for scan in self._scans):
            return 1.0
        count = other.count[cells].astype(np.float64) if isinstance(other, EpochMean) else 1.0
        return count / (count + 1.0)

    def others(self, epoch: EpochRef) -> EpochRef | EpochMean:
        """Return the mean of all scans but that of an epoch, or the epoch of a single one.

        Every scan has the same weight. Its covariance is for the difference of that epoch to it: what is
        common to systematic errors does not average out, and the rest may last for hours. Source:
        equations.md, 6.19.
        """
        if self._last is None or self._last[0] != epoch:
            self._last = epoch, self._others(epoch)
        return self._last[1]

    def _others(self, epoch: EpochRef) -> EpochRef | EpochMean:
        chosen = np.array([scan.epoch != epoch for scan in self._scans])
        scans = [scan for scan in self._scans if scan.epoch != epoch]
        if len(scans) < 2:
            return scans[0].epoch if scans else epoch
        seen, cells, sums = self._seen[chosen], self._cells, self._sums
        if len(scans) < len(self._scans):
            sums = sums - np.nan_to_num(self._values(epoch))
        count = seen.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = replace(
                scans[int(seen.sum(axis=1).argmax())],
                change_m=sums[0] / count,
                random_m=np.sqrt(sums[1] / count**2 + scans[0].reference.random_variance_m2[cells]),
            )
        number = np.zeros(cells.shape, np.float32)
        number[cells] = count
        if mean.shared is None:
            return EpochMean(cells, mean, number)
        members = [scan.shared for scan in scans if scan.shared is not None]
        lasting = _lasting([epoch.time_s, *(scan.epoch.time_s for scan in scans)])
        if len(scans) < len(self._scans):
            single, common = _mean_parameters(scans, members)
        else:
            single, common = self._parameters = self._parameters or _mean_parameters(scans, members)
        share = float(_own_share(lasting, np.ones((len(scans), 1), np.bool_))[0])
        mean = replace(
            mean,
            shared=_mean_of(single, common, share, 1 / len(scans)),
            members=(mean.shared, *(shared for shared in members if shared is not mean.shared)),
        )
        if (count == len(scans)).all():
            return EpochMean(cells, mean, number)
        factor = np.ones(cells.shape, np.float32)
        factor[cells] = self._factor(mean, seen, lasting, single, common)
        return EpochMean(cells, replace(mean, jacobian_factor=factor), number)

    def _factor(
        self, mean: EpochCells, seen: Bools, lasting: Floats, single: SharedParameters,
        common: SharedParameters,
    ) -> Floats:  # fmt: skip
        """Return the factor (n,) of the Jacobian by which the systematic error of a cell is larger.

        Where a part of the scans (k, n) observed it, there are fewer to average.
        """
        factor, partly = np.ones(seen.shape[1]), ~seen.all(axis=0) & seen.any(axis=0)
        cells = np.zeros_like(self._cells)
        cells[self._cells] = partly
        seen, count = seen[:, partly], seen[:, partly].sum(axis=0)
        jacobian = self._aggregates.jacobian(mean, cells)
        own_m2, common_m2, line_m2 = (
            np.asarray(jacobian.variance(shared), np.float64)
            for shared in (
                _mean_of(single, common, 1.0, 0.0),
                _mean_of(single, common, 0.0, 0.0),
                _mean_of(single, replace(single, covariance=0.0 * single.covariance), 0.0, 1.0),
            )
        )
        all_m2 = np.asarray(jacobian.variance(mean.shared), np.float64) if mean.shared else own_m2
        variance_m2 = (
            common_m2 + _own_share(lasting, seen) * np.maximum(own_m2 - common_m2, 0.0) + line_m2 / count
        )
        ratio = np.divide(variance_m2, all_m2, out=np.ones(len(count)), where=all_m2 > 0)
        factor[partly] = np.sqrt(np.maximum(ratio, 1.0))
        return factor


def _kind(scan: EpochCells) -> tuple[str, bool, tuple[str, ...]]:
    """Return what scans must have in common for a mean."""
    names = scan.shared.names if scan.shared is not None else ()
    return scan.reference.version, scan.adjusted, names


def _lasting(times_s: list[float]) -> Floats:
    """Return the correlation (k, k) of errors of scans that last for hours."""
    return np.asarray(np.exp(-np.abs(np.subtract.outer(times_s, times_s)) / REFRACTION_CORRELATION_S))


def _own_share(lasting: Floats, seen: Bools) -> Floats:
    """Return the share (n,) of the variance of one scan that the mean of several adds to a difference.

    Of what is not common to scans. It is the larger of that of errors that differ from scan to scan and of
    those that last for hours, with the correlation (1 + k, 1 + k) of the other scan and those of the mean,
    of which each cell has the ones `seen` (k, n). Source: equations.md, 6.19.
    """
    count = seen.sum(axis=0)
    among = sum(inside * (row @ seen) for inside, row in zip(seen, lasting[1:, 1:], strict=True))
    return np.asarray(np.maximum(1 / count, among / count**2 - 2 * (lasting[0, 1:] @ seen) / count))


def _mean_parameters(
    scans: list[EpochCells], members: list[SharedParameters]
) -> tuple[SharedParameters, SharedParameters]:
    """Return the mean covariance of the parameters of a scan, and that between two scans."""
    single = replace(
        members[-1],
        covariance=np.mean([shared.covariance for shared in members], axis=0),
        line_tilt_variance=np.mean([shared.line_tilt_variance for shared in members], axis=0),
        change_errors=None,
    )
    between = np.zeros_like(single.covariance)
    for pair in combinations(scans, 2):
        covariance = common_error_covariance(list(pair))
        if covariance is not None:
            between += covariance + covariance.T
    return single, replace(single, covariance=between / (len(scans) * (len(scans) - 1)))


def _mean_of(
    single: SharedParameters, common: SharedParameters, share: float, line_share: float
) -> SharedParameters:
    """Return the parameters of a mean: what is common, and a share of the rest and of the line tilts."""
    return replace(
        single,
        covariance=common.covariance + share * (single.covariance - common.covariance),
        line_tilt_variance=line_share * single.line_tilt_variance,
    )
