"""The whole commissioning of a simulated package, live and from data-sheet numbers, against the truth."""

import numpy as np
import pytest

from calibration.rotations import difference
from daemon.demo_commissioning import commission_simulated
from drivers.sim.world import SimWorld
from surfclass.rig import parse_rig


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", [0, 3])
def test_every_step_passes_and_is_as_near_to_the_truth_as_is_promised(tmp_path, seed):
    rig = parse_rig(commission_simulated(tmp_path, seed), "commissioned")
    package = SimWorld("cell", seed).package
    for found, true in ((rig.rgb, package.rgb), (rig.depth, package.depth)):
        assert max(abs(found.fx / true.fx - 1), abs(found.fy / true.fy - 1)) < 1e-3
        assert np.hypot(found.cx - true.cx, found.cy - true.cy) < 1e-3 * true.size[0]
    for found, true, most_m, most_deg in (
        (rig.rgb_T_depth, package.rgb_T_depth, 3e-4, 0.03),
        (rig.flange_T_depth, package.flange_T_depth, 5e-4, 0.05),
    ):
        off = difference(found, true)
        assert np.linalg.norm(off[3:]) < most_m
        assert np.degrees(np.linalg.norm(off[:3])) < most_deg
    light = np.array(rig.light.position_rgb_m) - package.led.position_m
    assert np.linalg.norm(light) < 2e-3
