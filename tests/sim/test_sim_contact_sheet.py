"""The contact sheet draws every scene and writes nothing half."""

import cv2
import numpy as np
import pytest

from drivers.sim.contact_sheet import main


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_the_sheet_shows_every_scene(tmp_path, ending):
    out = tmp_path / f"sheet{ending}"
    assert main([str(out), "--scale", "0.05"]) == 0
    image = cv2.imread(str(out))
    assert image.shape == (8 * 198 + 18, 1920, 3)
    colour_tiles = [image[198 * row + 18 : 198 * row + 190, 0:230].std() for row in range(8)]
    assert min(colour_tiles) > 3  # no tile is empty
    assert len(np.unique(image[18:190, 720:950].reshape(-1, 3), axis=0)) > 3


def test_an_unknown_ending_is_refused_and_writes_nothing(tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        main([str(tmp_path / "sheet.gif"), "--scale", "0.05"])
    assert caught.value.code == 2
    assert "allowed endings" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
