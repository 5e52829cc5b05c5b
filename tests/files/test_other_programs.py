"""What files of other programs mean beyond their usual shape is read so, or refused: nothing of it is dropped unsaid."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.files.test_readers import load, poses


def _chain(count: int) -> dict[str, dict[str, object]]:
    """A camchain in which camera n is 2^n to the right of the one before, and has a focal length of 500 + n."""
    cameras: dict[str, dict[str, object]] = {}
    for i in range(count):
        cameras[f"cam{i}"] = {"camera_model": "pinhole", "distortion_model": "radtan", "resolution": [640, 480]}
        cameras[f"cam{i}"] |= {"intrinsics": [500.0 + i, 500.0, 320.0, 240.0], "distortion_coeffs": [0.1, 0, 0, 0]}
        if i:
            place = np.eye(4)
            place[0, 3] = -(2.0**i)
            cameras[f"cam{i}"]["T_cn_cnm1"] = place.tolist()
    return cameras


def test_kalibr_chains_more_than_ten_cameras_by_their_numbers(tmp_path: Path) -> None:
    """It writes them in the alphabet's order, cam10 before cam2; they were chained in that of the file."""
    text = yaml.safe_dump(_chain(12))  # which sorts, as Kalibr does
    assert text.index("cam10") < text.index("cam2")
    both = load(tmp_path, "camchain.yaml", text)
    assert both.t[:, 0].tolist() == [2.0 - 2.0 ** (i + 1) for i in range(12)]
    assert both.K[:, 0, 0].tolist() == [500.0 + i for i in range(12)]
    assert load(tmp_path, "camchain.yaml", text, camera=2).K[0, 0] == 502
    backwards = dict(reversed(_chain(3).items()))
    assert load(tmp_path, "camchain.yaml", yaml.safe_dump(backwards, sort_keys=False)).t[:, 0].tolist() == [0, -2, -6]


def test_kalibr_s_chain_wants_the_camera_before(tmp_path: Path) -> None:
    chain = _chain(4)
    del chain["cam2"]
    with pytest.raises(ValueError, match="cam3, T_cn_cnm1: want cam2, from which it leads, got none"):
        load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))


def test_kalibr_s_cameras_have_no_more_than_is_read(tmp_path: Path) -> None:
    chain = _chain(1)
    chain["cam0"]["k3"] = 0.1
    with pytest.raises(ValueError, match="k3: want a name that is known to hold the lens"):
        load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))
    chain = _chain(1)
    chain["cam0"]["extrinsics"] = np.eye(4).tolist()
    with pytest.warns(UserWarning, match=r"cam0\.extrinsics: a pose that is not read"):
        np.testing.assert_array_equal(poses(load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))), np.eye(4))
