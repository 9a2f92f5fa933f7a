"""Reprocessing on a Dask cluster gives the same numbers as on this machine; an unequal cluster is refused."""

import shutil
from dataclasses import replace

import pytest
from support.series import open_with_processing, without_dates

from station.config import read_site
from station.errors import ConfigError, NotReadyError
from station.operations.batch import process_scans
from station.operations.reprocessing import reprocess
from station.processing.workers import dask_executor
from station.simulation.station import simulate, small

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    """Return a station with three stored epochs, all of them outdated."""
    folder = tmp_path_factory.mktemp("processed") / "station"
    simulate(folder, replace(small(hours=3), avalanche_m=0.0))
    site = read_site(folder / "site.toml")
    process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None)
    path = folder / "site.toml"
    path.write_text(path.read_text().replace("min_points = 1", "min_points = 2"))
    return folder


def read_series(folder):
    with open_with_processing(folder / "data") as series:
        return without_dates(series.load())


@pytest.mark.slow
def test_cluster_and_local_processes_give_the_same_series(processed, scheduler, tmp_path):
    folders = [shutil.copytree(processed, tmp_path / name) for name in ("cluster", "local")]
    for folder, address in zip(folders, (scheduler, None), strict=True):
        messages = []
        site = read_site(folder / "site.toml")
        assert reprocess(site, (None, None), messages.append, scheduler=address) == 0, messages
        assert messages[0] == "3 epochs to reprocess"
    on_cluster, on_this_machine = map(read_series, folders)
    assert on_cluster.identical(on_this_machine)
    assert not on_cluster.identical(read_series(processed))


@pytest.mark.slow
def test_cluster_with_other_folders_or_versions_is_refused(processed, scheduler, tmp_path, monkeypatch):
    site = read_site(processed / "site.toml")
    other_site = site.model_copy(
        update={"scans": site.scans.model_copy(update={"inbox": tmp_path / "missing"})}
    )
    with pytest.raises(ConfigError, match="missing is not readable on the worker"):
        dask_executor.DaskExecutor(scheduler, other_site)
    expected = dask_executor.versions()
    monkeypatch.setattr(dask_executor, "versions", lambda: {**expected, "numpy": "1.2.3"})
    with pytest.raises(ConfigError, match=rf"numpy {expected['numpy']}, here 1\.2\.3"):
        dask_executor.DaskExecutor(scheduler, site)
    assert not list(site.station.data.glob(".cluster-*"))


def test_no_answer_raises_not_ready(make_site, monkeypatch):
    monkeypatch.setattr(dask_executor, "CONNECT_TIMEOUT_S", 0.5)
    with pytest.raises(NotReadyError, match="no Dask scheduler answers"):
        dask_executor.DaskExecutor("tcp://127.0.0.1:9", make_site())
