"""The series as QGIS reads it, without a screen: as a raster of bands, and as a mesh with a time axis."""

import json
import os
import subprocess

import pytest

from station.archive import epochs
from station.archive.series.virtual import build_series

pytestmark = pytest.mark.integration
PYTHON = "/usr/bin/python3"  # Debian's, which QGIS belongs to
SCRIPT = """
import json, sys
from qgis.core import QgsApplication, QgsMeshDatasetIndex, QgsMeshLayer, QgsPointXY, QgsRasterLayer
series, *positions = json.loads(sys.argv[1])
QgsApplication.setPrefixPath("/usr", True)
application = QgsApplication([], False)
application.initQgis()
raster = QgsRasterLayer(f'NETCDF:"{series}":elevation_change', "change")
bands = range(1, raster.bandCount() + 1)
samples = [[raster.dataProvider().sample(QgsPointXY(*at), band) for band in bands] for at in positions]
mesh = QgsMeshLayer(series, "mesh", "mdal")
data = mesh.dataProvider()
groups = [QgsMeshDatasetIndex(index, 0) for index in range(data.datasetGroupCount())]
print(json.dumps({
    "crs": raster.crs().authid(),
    "size": [raster.width(), raster.height()],
    "samples": samples,
    "epochs": {data.datasetGroupMetadata(group).name(): data.datasetCount(group) for group in groups},
}))
"""


@pytest.fixture
def qgis():
    """Run the script in QGIS's own interpreter; without QGIS, skip the test."""
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}

    def run(code, *arguments):
        command = [PYTHON, "-c", code, *arguments]
        return subprocess.run(
            command, check=False, capture_output=True, text=True, env=environment, timeout=120
        )

    if not os.access(PYTHON, os.X_OK) or run("import qgis.core").returncode:
        pytest.skip("python3-qgis is not installed")
    return lambda *arguments: json.loads(run(SCRIPT, json.dumps(arguments)).stdout)


def test_qgis_reads_the_series(series, epoch, qgis):
    values = (0.0, 0.01, 0.02, 0.03)  # change in the western half [m]; nothing is known of the eastern one
    for hour in range(len(values)):
        epochs.write_epoch(series, epoch(hour))
    seen, unseen = (632_055, 5_185_955), (633_255, 5_185_955)
    layer = qgis(str(build_series(series)), seen, unseen)
    assert (layer["crs"], layer["size"]) == ("EPSG:32632", [150, 140])
    of_seen, of_unseen = layer["samples"]
    assert [value for value, _ in of_seen] == pytest.approx(values, abs=1e-6)
    assert not any(known for _, known in of_unseen)
    assert layer["epochs"]["elevation above the reference surface"] == len(values)
