"""The series of exposures: from just not dark to just not saturated, all from one place, and back."""

from dataclasses import replace

import numpy as np
import pytest
from guided_site import SETTINGS, CountingGuide, Person, site

from calibration.live.exposures import exposure_series
from calibration.live.loop import guided
from drivers.errors import CaptureRejectedError
from drivers.sensor_package import SensorPackage
from drivers.sim.devices import SimColourCamera
from surfclass.errors import InputError


def series(at, count=8):
    return exposure_series(at.package, count, lambda sentence: None)


def middles(captures):
    """Of each image's middle: the median of the darkest channel and the 0.99 quantile of the brightest."""
    found = []
    for capture in captures:
        rgb = capture.colour.rgb
        part = rgb[rgb.shape[0] // 3 : -(rgb.shape[0] // 3), rgb.shape[1] // 3 : -(rgb.shape[1] // 3)]
        found.append(
            (np.median(part, axis=(0, 1)).min() / 255, np.quantile(part, 0.99, axis=(0, 1)).max() / 255)
        )
    return np.array(found)


def test_exposures_are_evenly_spaced_from_just_not_dark_to_just_not_saturated(tmp_path):
    with site(tmp_path, "exposure_card", exposure_s=0.02) as at:
        captures = series(at)
    exposures = np.array([capture.colour.exposure_s for capture in captures])
    ratios = exposures[1:] / exposures[:-1]
    assert ratios == pytest.approx(np.full(7, ratios.mean()), rel=0.08)  # of whole rows
    dark, bright = middles(captures).T
    assert 0.05 < dark[0] < 0.12
    assert 0.9 < bright[-1] <= 0.97
    assert (np.diff(dark) > 0).all()
    assert {capture.role for capture in captures} == {"exposure"}


@pytest.mark.parametrize("exposure_s", [0.0003, 0.1])
def test_it_does_not_matter_how_the_exposure_is_set_before_and_it_is_set_so_again(tmp_path, exposure_s):
    with site(tmp_path, "exposure_card", exposure_s=exposure_s) as at:
        captures = series(at)
        after = at.package.capture("after")
    dark, bright = middles(captures).T
    assert 0.05 < dark[0] < 0.12
    assert 0.9 < bright[-1] <= 0.97
    assert after.colour.exposure_s == pytest.approx(exposure_s)


def test_a_target_that_no_exposure_shows_is_refused_with_what_to_change(tmp_path):
    with site(tmp_path, "exposure_card") as at:
        at.package.settings = replace(at.package.settings, light_level=0.0)
        with pytest.raises(InputError, match=r"dark even with 75 ms: change the light's level"):
            series(at)


def test_too_short_a_series_is_refused(tmp_path):
    with site(tmp_path, "exposure_card") as at, pytest.raises(InputError, match="allowed are 3 or more"):
        series(at, 2)


class FixedColourCamera(SimColourCamera):
    """A camera whose exposure cannot be changed."""

    def exposure_range_s(self):
        return 0.01, 0.01


def test_a_camera_whose_exposure_cannot_be_changed_is_refused_with_the_other_way(tmp_path):
    with site(tmp_path, "exposure_card") as at:
        package = SensorPackage(at.world.clock, FixedColourCamera(at.world), at.package._depth, None, None)
        with package, pytest.raises(InputError, match="at several distances instead"):
            exposure_series(package, 8, lambda sentence: None)


def test_an_arm_that_goes_on_between_two_exposures_spoils_the_series(tmp_path):
    with site(tmp_path, "grey_card", dwell_s=0.05) as at:
        with pytest.raises(CaptureRejectedError, match="moved"):
            series(at)
        at.world.clock.sleep(10.0)
        assert at.package.capture("after").colour.exposure_s == pytest.approx(0.010)


def test_the_guided_capture_takes_a_series_where_the_arm_rests(tmp_path):
    person = Person()
    with site(tmp_path, "exposure_card", exposure_s=0.02) as at:
        guide = CountingGuide("exposure", needed=8)
        assert guided(at.package, guide, at.writer, SETTINGS, person, at.world.clock) == 8
    exposures = [capture.colour.exposure_s for capture in at.captures]
    assert exposures == sorted(exposures)
    assert exposures[-1] > 10 * exposures[0]
    assert any("8 exposures from" in shown.notice for shown in person.shown)


def test_a_series_that_the_arm_spoilt_is_taken_where_it_stays(tmp_path):
    person = Person()
    with site(tmp_path, "grey_card", viewpoints=3) as at:
        guide = CountingGuide("exposure", needed=8)
        assert guided(at.package, guide, at.writer, SETTINGS, person, at.world.clock) == 8
        place = at.world.viewpoints[-1].q
    assert all(np.abs(capture.joints.q - place).max() < 1e-3 for capture in at.captures)
    assert person.last.count("rejected") == 2
