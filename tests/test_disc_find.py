"""Reflector discs in IR and depth images: bias, spread against what is reported, and what makes it hard."""

import cv2
import numpy as np
import pytest
from disc_scenes import CAMERA, PLACES_M, RADIUS_M, Plate, find_discs

from calibration.hand_eye.discs_find import look_for_discs
from calibration.hand_eye.discs_picture import draw_discs
from surfclass.errors import InputError
from surfclass.frames import DepthFrame
from surfclass.geometry import project


def found(plate, edit=None):
    return find_discs(plate.frame(edit), CAMERA, RADIUS_M)


def matched(discs, plate):
    """Each disc's true index; every one must be within two pixels of its own."""
    distance = np.linalg.norm(np.array([disc.pixel for disc in discs])[:, None] - plate.pixels[None], axis=2)
    assert distance.min(axis=1).max() < 2.0
    index = distance.argmin(axis=1)
    assert len(set(index)) == len(index)
    return index


def errors(discs, plate):
    index = matched(discs, plate)
    pixel = np.array([disc.pixel for disc in discs]) - plate.pixels[index]
    place = np.array([disc.camera_m for disc in discs]) - plate.centres_m[index]
    return pixel, place


def check(discs, plate, count=9, worst_px=0.5, worst_m=0.0015):
    assert len(discs) == count
    pixel, place = errors(discs, plate)
    assert np.linalg.norm(pixel, axis=1).max() < worst_px
    assert np.linalg.norm(place, axis=1).max() < worst_m


VIEWS = [(3, 0, 0), (25, 0, 10), (0, -30, 0), (-20, 25, 60)]


@pytest.fixture(scope="module")
def many():
    """Errors and their reported covariances over views and seeds."""
    pixel, place, pixel_sd, place_sd = [], [], [], []
    for seed, tilt in enumerate(VIEWS):
        plate = Plate(tilt, seed=seed)
        discs = found(plate)
        assert len(discs) == 9
        of_pixel, of_place = errors(discs, plate)
        pixel.append(of_pixel)
        place.append(of_place)
        pixel_sd.append([np.sqrt(np.diag(disc.pixel_covariance)) for disc in discs])
        place_sd.append([np.sqrt(np.diag(disc.camera_covariance)) for disc in discs])
    return tuple(np.concatenate(part) for part in (pixel, place, pixel_sd, place_sd))


def test_centres_have_no_bias_and_a_spread_of_a_tenth_of_a_pixel(many):
    pixel, place, _, _ = many
    assert np.abs(pixel.mean(axis=0)).max() < 0.05
    assert pixel.std(axis=0).max() < 0.15
    assert np.abs(place.mean(axis=0)).max() < 0.0001
    assert place.std(axis=0).max() < 0.0004


def test_reported_standard_deviations_hold_against_the_truth(many):
    pixel, place, pixel_sd, place_sd = many
    for error, sd in ((pixel, pixel_sd), (place, place_sd)):
        assert 0.6 < np.sqrt(np.mean((error / sd) ** 2)) < 1.5


def test_the_centre_of_the_ellipse_would_be_off_where_the_lens_and_the_tilt_make_it():
    plate = Plate((0, 60, 0), (0.12, 0.05, 0.45), PLACES_M[[4]] * 0.4, speckle=0.05, noise_counts=0.5)
    (disc,) = found(plate)
    outline = disc.outline.astype(np.float32)
    ellipse = np.array(cv2.fitEllipse(outline)[0])
    assert np.linalg.norm(ellipse - plate.pixels[0]) > 0.4
    assert np.linalg.norm(disc.pixel - plate.pixels[0]) < 0.1


def test_a_plate_tilted_by_fifty_degrees_is_measured():
    plate = Plate((0, 50, 0), seed=3)
    check(found(plate), plate)


@pytest.mark.parametrize("scale", [0.01, 0.1, 8.0])
def test_exposure_does_not_matter(scale):
    plate = Plate()
    frame = plate.frame(lambda counts, depth: (counts * scale, depth))
    check(find_discs(frame, CAMERA, RADIUS_M), plate)


def test_eight_bits_are_as_good():
    plate = Plate()
    frame = plate.frame()
    eight = (frame.ir // 4).astype(np.uint8)
    check(find_discs(DepthFrame(0, 0, None, frame.depth_mm, eight), CAMERA, RADIUS_M), plate)


@pytest.mark.parametrize("reading", ["missing", "wrong"])
def test_saturated_discs_take_the_plane_of_the_ring_around_them(reading):
    plate = Plate()
    near = plate.mask(1.05)
    factor = {"missing": 0.0, "wrong": 1.05}[reading]

    discs = found(plate, lambda counts, depth: (counts * 12, np.where(near, factor * depth, depth)))
    check(discs, plate)
    assert all(disc.ring_only and disc.saturated > 0.9 for disc in discs)


def test_without_saturation_the_discs_own_depth_counts_although_the_ring_lies_deeper():
    plate = Plate()
    beside = plate.mask(3) & ~plate.mask(1.05)
    discs = found(plate, lambda counts, depth: (counts, np.where(beside, depth + 0.02, depth)))
    check(discs, plate)
    assert not any(disc.ring_only for disc in discs)


def test_a_quarter_of_the_depth_may_be_missing():
    plate = Plate()
    blotch = cv2.GaussianBlur(np.random.default_rng(0).normal(size=CAMERA.shape), (0, 0), 2)
    lost = blotch > np.quantile(blotch, 0.75)
    check(found(plate, lambda counts, depth: (counts, np.where(lost, 0, depth))), plate)


def test_bright_things_beside_the_plate_are_no_discs_and_say_why():
    plate = Plate()

    def shine(counts, depth):
        cv2.rectangle(counts, (2, 40), (40, 440), 1023, -1)
        cv2.circle(counts, (600, 60), 15, 1023, -1)
        cv2.rectangle(counts, (590, 400), (630, 418), 1023, -1)
        return counts, depth

    sighting = look_for_discs(plate.frame(shine), CAMERA, RADIUS_M)
    check(sighting.discs, plate)
    assert len(sighting.rejected) >= 2
    assert all(one.reason for one in sighting.rejected)


def test_a_disc_of_another_radius_is_none():
    plate = Plate()
    frame = plate.frame()
    assert find_discs(frame, CAMERA, 0.75 * RADIUS_M) == []
    sighting = look_for_discs(frame, CAMERA, 1.3 * RADIUS_M)
    assert sighting.discs == ()
    assert any("radius" in one.reason or "outline" in one.reason for one in sighting.rejected)


def test_discs_that_the_border_cuts_are_left_out_and_the_others_kept():
    plate = Plate((0, 0, 0), (0.26, 0.0, 0.85), seed=8)
    radius = CAMERA.fx * RADIUS_M / 0.85
    whole = (plate.pixels[:, 0] < 639 - radius - 3).sum()
    cut = ((plate.pixels[:, 0] > 639 - radius + 2) & (plate.pixels[:, 0] < 639 + radius - 4)).sum()
    assert 4 <= whole < 9
    assert cut >= 1
    sighting = look_for_discs(plate.frame(), CAMERA, RADIUS_M)
    check(sighting.discs, plate, whole)
    assert sum("border" in one.reason for one in sighting.rejected) >= cut


def test_discs_that_shine_into_each_other_are_parted():
    gap = 2 * RADIUS_M + 0.002
    places = np.array([[-0.1, -0.05, 0], [-0.1 + gap, -0.05, 0], [0.1, 0.1, 0], [0.1, 0.1 + gap, 0]])
    plate = Plate((10, 10, 0), places_m=places, blur_px=1.2, seed=9)
    check(found(plate, lambda counts, depth: (counts * 3, depth)), plate, 4)


def test_a_disc_half_hidden_is_left_out():
    plate = Plate()
    column = int(plate.pixels[4, 0])
    rows = slice(int(plate.pixels[4, 1]) - 30, int(plate.pixels[4, 1]) + 30)

    def hide(counts, depth):
        counts[rows, column : column + 40] = 8
        return counts, depth

    discs = found(plate, hide)
    check(discs, plate, 8)
    assert 4 not in matched(discs, plate)


def test_nothing_is_found_where_nothing_is():
    noise = np.random.default_rng(0).integers(0, 30, CAMERA.shape).astype(np.uint16)
    depth = np.full(CAMERA.shape, 900, np.uint16)
    for ir in (noise, np.zeros(CAMERA.shape, np.uint16), np.full(CAMERA.shape, 1023, np.uint16)):
        assert find_discs(DepthFrame(0, 0, None, depth, ir), CAMERA, RADIUS_M) == []


def test_without_any_depth_discs_are_rejected_for_that():
    plate = Plate()
    sighting = look_for_discs(plate.frame(lambda counts, depth: (counts, 0 * depth)), CAMERA, RADIUS_M)
    assert sighting.discs == ()
    assert any("depth" in one.reason for one in sighting.rejected)


def test_what_is_asked_must_make_sense():
    depth = np.zeros(CAMERA.shape, np.uint16)
    with pytest.raises(InputError, match="no IR image"):
        find_discs(DepthFrame(0, 0, None, depth), CAMERA, RADIUS_M)
    with pytest.raises(InputError, match="radius"):
        find_discs(DepthFrame(0, 0, None, depth, depth), CAMERA, 0.0)
    with pytest.raises(InputError, match="depth image"):
        find_discs(DepthFrame(0, 0, None, depth[:100], depth[:100]), CAMERA, RADIUS_M)


def test_the_picture_shows_discs_green_and_rejected_blobs_orange():
    plate = Plate()

    def shine(counts, depth):
        cv2.rectangle(counts, (590, 400), (630, 418), 1023, -1)
        return counts, depth

    frame = plate.frame(shine)
    sighting = look_for_discs(frame, CAMERA, RADIUS_M)
    picture = draw_discs(frame.ir, sighting, [None, *range(2, 10)])
    assert picture.shape == (*CAMERA.shape, 3)
    red, green, blue = (picture[..., channel].astype(int) for channel in range(3))
    for disc in sighting.discs:
        x, y = np.round(project(disc.camera_m, CAMERA)).astype(int)
        assert (red - green)[y - 1 : y + 2, x - 1 : x + 2].max() > 60
    assert ((green - red > 80) & (green > blue)).sum() > 9 * 40
    assert (red - blue > 80)[395:425, 585:635].sum() > 60


@pytest.mark.parametrize("seed", range(24))
def test_whatever_the_image_nothing_breaks_and_every_covariance_is_one(seed):
    rng = np.random.default_rng(seed)
    width, height = [(80, 60), (160, 120), (320, 240)][seed % 3]
    camera = CAMERA.model_copy(
        update={
            "size": (width, height),
            "fx": 0.9 * width,
            "fy": 0.9 * width,
            "cx": width / 2,
            "cy": height / 2,
        }
    )
    ir = rng.integers(0, rng.choice([2, 30, 300]), (height, width)).astype(np.uint16)
    for _ in range(rng.integers(0, 12)):
        middle, axes = rng.integers(0, [width, height]).tolist(), rng.integers(1, 25, 2).tolist()
        cv2.ellipse(ir, middle, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(1, 1024)), -1)
    depth = rng.integers(300, 3000) + rng.normal(0, rng.choice([0, 3, 300]), ir.shape)
    depth[rng.random(ir.shape) < rng.choice([0, 0.3, 0.95])] = 0
    frame = DepthFrame(0, 0, None, np.clip(depth, 0, 65535).astype(np.uint16), ir)
    for disc in find_discs(frame, camera, float(rng.choice([0.005, 0.03, 0.1]))):
        assert np.linalg.eigvalsh(disc.pixel_covariance).min() > 0
        assert np.linalg.eigvalsh(disc.camera_covariance).min() > 0
        assert disc.depth_sd_m > 0
        assert 0 <= disc.saturated <= 1
