"""The physics of the simulated light: fall-off, angle, shadow, specular lobe, vignetting, response."""

import cv2
import numpy as np
import pytest

from drivers.sim import truth
from drivers.sim.scenes import viewpoints
from drivers.sim.world import SimWorld
from surfclass.rig import parse_rig

SCALE = 0.1


@pytest.fixture(scope="module")
def card():
    return SimWorld("grey_card", scale=SCALE)


def view(world, name):
    return next(one for one in world.viewpoints if one.name == name)


def expected(world, q, albedo):
    """The card's irradiance by the model's formula, written out for every pixel."""
    seen = truth.surface(world, q)
    led = world.package.led
    to_light = np.array(led.position_m)[:, None, None] - seen.point
    distance = np.linalg.norm(to_light, axis=0)
    cosine = (to_light * seen.normal).sum(axis=0) / distance
    emission = -(to_light * np.array(led.axis)[:, None, None]).sum(axis=0) / distance
    r2 = (world.package.rgb_rays**2).sum(axis=0)
    vignetting = 1 - 2.0 * r2 + 1.6 * r2**2 - 0.5 * r2**3
    return led.gain_m2 * albedo * cosine * emission**led.falloff_exponent / distance**2 * vignetting


@pytest.mark.parametrize("name", ["at_0550", "at_0650", "at_1300", "turned_20", "turned_47"])
def test_a_matte_card_follows_inverse_square_cosine_emission_and_vignetting(card, name):
    q = view(card, name).q
    image = card.irradiance(q)
    on_card = card.hits(q, "rgb").face == 0
    inside = cv2.erode(on_card.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
    assert inside.mean() > 0.7
    wanted = expected(card, q, 0.5)[inside]
    for channel in range(3):
        assert image[..., channel][inside] == pytest.approx(wanted, rel=2e-3)


def test_light_falls_with_the_square_of_the_distance(card):
    near, far = (card.irradiance(view(card, name).q) for name in ("at_0650", "at_1300"))
    centre = near.shape[0] // 2, near.shape[1] // 2
    # The LED lies beside the camera, so twice the camera's distance is not quite twice the light's.
    assert near[centre][0] / far[centre][0] == pytest.approx(4, rel=0.06)


def test_the_corner_is_darker_by_the_stated_vignetting(card):
    vignetting = card.package.vignetting
    assert vignetting.max() == pytest.approx(1, abs=1e-3)
    corners = vignetting[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert ((corners > 0.5) & (corners < 0.7)).all()
    assert corners.min() == vignetting.min()


def test_the_light_scales_with_level_and_exposure(card):
    q = card.viewpoints[2].q
    full = card.irradiance(q)
    assert card.irradiance(q, level=0.25) == pytest.approx(0.25 * full, rel=1e-4)
    assert card.irradiance(q, exposure_s=0.020) == pytest.approx(2 * full, rel=1e-4)
    assert card.irradiance(q, level=0.0).max() == 0


def test_ambient_light_is_there_without_the_led():
    world = SimWorld("grey_card", scale=SCALE, ambient=0.05)
    dark = world.irradiance(world.viewpoints[2].q, level=0.0)
    assert dark == pytest.approx(0.05 * 0.5 * world.package.vignetting[..., None] + 0 * dark, rel=1e-3)


@pytest.mark.parametrize(
    ("scene", "name"),
    [
        ("cell", "corner_090"),
        ("cell", "lower_075"),
        ("checkerboard", "tilt_04"),
        ("reflector_discs", "tilt_00"),
    ],
)
def test_a_shadow_is_where_the_line_to_the_light_is_blocked(scene, name):
    """Against brute force: a ray from each place to the LED, tested with every rectangle."""
    world = SimWorld(scene, scale=0.2)
    q = view(world, name).q
    seen = truth.surface(world, q)
    image = world.irradiance(q).max(axis=2)
    light = world.base_T_rgb(q) @ np.array(world.package.led.position_m)
    points = (world.base_T_rgb(q) @ seen.point.transpose(1, 2, 0)).astype(np.float64)
    normals = seen.normal.transpose(1, 2, 0) @ world.base_T_rgb(q).rotation.T
    facing = ((light - points) * normals).sum(axis=2)
    well_inside, near_shadow = np.zeros(facing.shape, bool), np.zeros(facing.shape, bool)
    for one in world.scene.surfaces:
        to_light = light - points
        with np.errstate(divide="ignore", invalid="ignore"):
            part = ((one.corner - points) @ one.normal) / (to_light @ one.normal)
        crossing = points + part[..., None] * to_light - one.corner
        s, t = crossing @ one.along_s, crossing @ one.along_t
        ahead = (part > 2e-3) & (part < 1)
        # The LED's disc, seen from the surface, is a disc of this radius where the ray crosses.
        penumbra = world.package.led.radius_m * part + 1e-3
        for grow, hidden in ((-penumbra, well_inside), (penumbra + 0.003, near_shadow)):
            inside = (s > -grow) & (s < one.size_m[0] + grow) & (t > -grow) & (t < one.size_m[1] + grow)
            hidden |= ahead & inside
    # Defocus mixes neighbours, so only places whose surroundings are alike are asked.
    alike = np.ones((5, 5))
    dark = cv2.erode((well_inside & seen.hit).astype(np.uint8), alike) > 0
    clear = cv2.erode((seen.hit & ~near_shadow & (facing > 0.05)).astype(np.uint8), alike) > 0
    assert dark.sum() > 30
    assert np.percentile(image[dark], 95) < 2e-4
    assert clear.mean() > 0.3
    assert image[clear].min() > 5e-4


def test_the_highlight_is_where_the_mirror_direction_is():
    world = SimWorld("highlight_board", scale=SCALE)
    for one in world.viewpoints:
        image = world.irradiance(one.q).mean(axis=2)
        seen = truth.surface(world, one.q)
        light = np.array(world.package.led.position_m)
        n, p = seen.normal[:, 0, 0].astype(float), seen.point[:, 0, 0].astype(float)
        height_light, height_camera = (light - p) @ n, -p @ n
        foot_light, foot_camera = light - height_light * n, -height_camera * n
        share = height_camera / (height_camera + height_light)
        mirror = foot_camera + share * (foot_light - foot_camera)
        peak = np.unravel_index(np.argmax(image), image.shape)
        found = seen.point[:, peak[0], peak[1]]
        assert np.linalg.norm(found - mirror) < 0.03  # the fall-off of light pulls the peak a little


def test_the_response_inverse_in_the_rig_gives_linear_light_back(card):
    rig = parse_rig(truth.rig(card), "truth")
    q = view(card, "at_0800").q
    linear = card.irradiance(q)
    image = np.mean([card.render_colour(q, 1.0, key) for key in range(8)], axis=0) / 255
    curves = np.array(rig.response.inverse)
    level = np.linspace(0, 1, curves.shape[1])
    for channel in range(3):
        back = np.interp(image[..., channel], level, curves[channel])
        assert np.median(back / linear[..., channel]) == pytest.approx(1, abs=0.01)


def test_the_three_channels_have_their_own_response(card):
    curves = np.array(parse_rig(truth.rig(card), "truth").response.inverse)
    assert curves.shape[1] >= 64
    assert np.abs(curves[0] - curves[1]).max() > 0.005
    assert np.abs(curves[1] - curves[2]).max() > 0.005


def test_an_overexposed_image_saturates_at_full_scale(card):
    image = card.render_colour(card.viewpoints[0].q, 1.0, 1, exposure_s=0.1)
    assert (image == 255).mean() > 0.9


def test_every_scene_has_its_views_in_reach():
    for name in ("cell", "board:timber", "checkerboard", "reflector_discs", "grey_card", "highlight_board"):
        world = SimWorld(name, scale=0.05)
        for one in viewpoints(name):
            assert world.base_T_rgb(one.q).matrix == pytest.approx(one.base_T_rgb.matrix, abs=1e-9)
