"""Tables of tie features."""

import numpy as np
import pytest

from station.errors import ConfigError
from station.readers.tie_features import read_tie_features

HEAD = "name,x,y,z,ref_x,ref_y,ref_z,normal_x,normal_y,normal_z,sigma\n"


def write_table(tmp_path, text):
    path = tmp_path / "features.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_points_and_planes(tmp_path):
    features = read_tie_features(
        write_table(
            tmp_path,
            "# survey of May\n\n" + HEAD + "hut,1.5,-2,3,635000.25,5185000,3000,,,,0.01\n"
            "roof , 4,5,6, 635001,5185001,3001, 0,0,2, 0.02  # pitched\n",
        )
    )
    assert features.names == ("hut", "roof")
    assert features.scan_m.tolist() == [[1.5, -2, 3], [4, 5, 6]]
    assert features.reference_m[0].tolist() == [635000.25, 5185000, 3000]
    assert features.normal.tolist() == [[0, 0, 0], [0, 0, 1]]
    assert features.is_plane.tolist() == [False, True]
    assert features.sigma_m.tolist() == [0.01, 0.02]


def test_columns_in_any_order_without_optional_ones(tmp_path):
    features = read_tie_features(
        write_table(tmp_path, "\ufeffSigma, Z, Y, X, ref_z, ref_y, ref_x\n0.1,3,2,1,6,5,4\n")
    )
    assert np.concatenate([features.scan_m, features.reference_m], axis=1).tolist() == [[1, 2, 3, 4, 5, 6]]
    assert features.names == ("feature_1",)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "missing x, y, z, ref_x, ref_y, ref_z, sigma"),
        ("x,y,z,ref_x,ref_y,ref_z,sigma,colour\n", "unknown colour"),
        (HEAD, "contains no feature"),
        (HEAD + "# none\nhut,1,2,three,4,5,6,,,,1\n", "line 3: z is 'three', not a number"),
        (HEAD + "hut,1,2,3,4,5\n", "line 2: ref_z is '', not a number"),
        (HEAD + "hut,1,2,3,4,5,6,,,,nan\n", "line 2: sigma is 'nan', not a number"),
        (HEAD + "hut,1,2,3,4,5,6,,,,0\n", r"line 2 \(hut\): sigma must be positive"),
        (HEAD + "hut,1,2,3,4,5,6,1,,,1\n", "line 2: normal_y is '', not a number"),
        (HEAD + "hut,1,2,3,4,5,6,0,0,0,1\n", r"line 2 \(hut\): the normal has length zero"),
    ],
)
def test_invalid_table_is_explained(tmp_path, text, reason):
    with pytest.raises(ConfigError, match=reason):
        read_tie_features(write_table(tmp_path, text))


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_tie_features(tmp_path / "nowhere.csv")
