"""Scans redone on a Dask cluster give the same numbers, and a cluster that might not is refused."""

import shutil
from dataclasses import replace

import pytest

import station
from station.config import read_site
from station.errors import ConfigError, NotReadyError
from station.service import cluster
from station.service.once import process_scans
from station.service.reprocess import reprocess
from station.simulation.station import simulate, tiny

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as made:
        yield made.scheduler_address


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "station"
    simulate(folder, replace(tiny(hours=3), avalanche_m=0.0))
    site = read_site(folder / "site.toml")
    process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None)
    path = folder / "site.toml"
    path.write_text(path.read_text().replace("min_points = 1", "min_points = 2"))
    return folder


def values(folder):
    with station.open(folder / "data") as series:
        return series.load()


@pytest.mark.slow
def test_a_cluster_and_our_own_cores_give_the_same(made, scheduler, tmp_path):
    folders = [shutil.copytree(made, tmp_path / name) for name in ("cluster", "cores")]
    for folder, address in zip(folders, (scheduler, None), strict=True):
        said = []
        site = read_site(folder / "site.toml")
        assert reprocess(site, (None, None), said.append, scheduler=address) == 0, said
        assert said[0] == "3 epochs to be done again"
    one, other = map(values, folders)
    assert one.identical(other)
    assert not one.identical(values(made))


@pytest.mark.slow
def test_a_cluster_that_might_compute_otherwise_is_refused(made, scheduler, tmp_path, monkeypatch):
    site = read_site(made / "site.toml")
    elsewhere = site.model_copy(
        update={"scans": site.scans.model_copy(update={"inbox": tmp_path / "not there"})}
    )
    with pytest.raises(ConfigError, match="not there cannot be read there"):
        cluster.Cluster(scheduler, elsewhere)
    ours = cluster.versions()
    monkeypatch.setattr(cluster, "versions", lambda: {**ours, "numpy": "1.2.3"})
    with pytest.raises(ConfigError, match=rf"numpy {ours['numpy']}, here 1\.2\.3"):
        cluster.Cluster(scheduler, site)
    assert not list(site.station.data.glob(".cluster-*"))


def test_no_cluster_there(make_site, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.5)
    with pytest.raises(NotReadyError, match="no Dask scheduler answers"):
        cluster.Cluster("tcp://127.0.0.1:9", make_site())
