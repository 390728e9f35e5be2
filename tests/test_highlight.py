"""The light's place from one board: corrected equations beside the printed ones."""

import numpy as np
import pytest
from raycast import make_rig, pixel_rays, tilted

from calibration.light.highlight import (
    LightSearch,
    diffuse_term,
    locate_light,
    reflect,
    relative_spread,
    split_regions,
)
from surfclass.errors import ConfigurationError, InputError
from surfclass.types import SurfaceView

LIGHT = np.array([-0.084, 0.037, -0.006])
SQUARE = (1.0, 0.0, 0.0)  # the polynomial of a linear camera
CAMERA = make_rig(rgb_size=(320, 240), rgb_f=406.0).rgb


def board(tilt_deg=8, about="y", distance_m=0.65, gloss=0.35, facets_rad=0.06, clip=True):
    """Torrance–Sparrow with Gaussian facets (Eq. 4.3) on an endless board, in a linear camera."""
    plane = tilted(tilt_deg, distance_m, about)
    ray = pixel_rays(CAMERA)
    point = ray * plane.hit(np.zeros(3), ray)[..., None]
    normal = np.array(plane.normal)
    to_camera = -point / np.linalg.norm(point, axis=-1, keepdims=True)
    away = LIGHT - point
    d = np.linalg.norm(away, axis=-1)
    to_light = away / d[..., None]
    half = to_camera + to_light
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    alpha = np.arccos(np.clip(half @ normal, -1, 1))
    cosine = to_light @ normal
    lobe = gloss / (to_camera @ normal) * np.exp(-(alpha**2) / (2 * facets_rad**2))
    intensity = (0.16 * cosine + lobe) / d**2
    if clip:
        intensity = np.minimum(intensity, 1.0)
    seen = np.ones(d.shape, bool)
    planes = [np.moveaxis(a, -1, 0).astype(np.float32) for a in (point, np.broadcast_to(normal, point.shape))]
    view = SurfaceView(
        *planes,
        np.linalg.norm(point, axis=-1).astype(np.float32),
        (to_camera @ normal).astype(np.float32),
        None,
        None,
        seen,
        seen,
    )
    return intensity.astype(np.float32), view, normal


@pytest.mark.parametrize(("tilt", "about"), [(0, "y"), (10, "y"), (-8, "x")])
def test_light_is_found(tilt, about):
    intensity, view, _ = board(tilt, about)
    found = locate_light(intensity, view, CAMERA, SQUARE)
    assert np.linalg.norm(found.position_rgb_m - LIGHT) < 0.03
    assert found.relative_spread < 0.01
    to_light = (LIGHT - found.highlight_m) / np.linalg.norm(LIGHT - found.highlight_m)
    assert np.degrees(np.arccos(to_light @ found.direction)) < 2
    assert found.position_rgb_m == pytest.approx(found.highlight_m + found.distance_m * found.direction)


def test_mirror_direction():
    normal = np.array([0.0, 0.6, -0.8])
    view = np.array([0.3, -0.4, -np.sqrt(0.75)])
    mirrored = reflect(view, normal)
    assert np.linalg.norm(mirrored) == pytest.approx(1)
    assert mirrored @ normal == pytest.approx(view @ normal)
    assert np.linalg.det([mirrored, view, normal]) == pytest.approx(0, abs=1e-12)
    assert mirrored != pytest.approx(view)


def spreads(along):
    """Relative and plain spread of f along the true direction from the highlight, at given distances."""
    intensity, view, normal = board()
    found = locate_light(intensity, view, CAMERA, SQUARE)
    chosen = np.flatnonzero(found.diffuse)
    points = view.point.reshape(3, -1)[:, chosen].T.astype(float)
    samples = intensity.ravel()[chosen].astype(float)
    true = LIGHT - found.highlight_m
    direction = true / np.linalg.norm(true)
    terms = [diffuse_term(samples, points, normal, found.highlight_m + d * direction, SQUARE) for d in along]
    plain = [((f - f.mean()) ** 2).sum() for f in terms]
    return np.linalg.norm(true), np.array([relative_spread(f) for f in terms]), np.array(plain)


def test_printed_argmax_of_4_8_is_at_the_end_of_any_search():
    distances = np.geomspace(0.05, 3.0, 300)
    truth, relative, plain = spreads(distances)
    assert distances[relative.argmin()] == pytest.approx(truth, rel=0.03)
    assert plain.argmax() in (0, len(distances) - 1)
    shorter = distances < 2.0
    assert plain[shorter].argmax() in (0, shorter.sum() - 1)


def test_scale_alone_drives_the_plain_spread():
    """f grows with the distance that is assumed. On pure noise the plain spread still prefers near lights."""
    distances = np.geomspace(0.2, 3.0, 60)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.2, 0.2, (2000, 2)), np.full(2000, 0.65)])
    noise = rng.uniform(0.2, 0.4, 2000)
    plain, relative = [], []
    for d in distances:
        term = diffuse_term(noise, points, np.array([0, 0, -1.0]), np.array([0, 0, 0.65 - d]), SQUARE)
        plain.append(((term - term.mean()) ** 2).sum())
        relative.append(relative_spread(term))
    far = distances > 0.6
    assert np.all(np.diff(np.array(plain)[far]) > 0)
    assert np.ptp(np.array(relative)[far]) < 0.25 * np.mean(np.array(relative)[far])
    assert plain[-1] / np.min(plain) > 50


def test_lobes_tail_without_guard_band_and_saturated_pixels_bias_the_answer():
    intensity, view, _ = board(6, facets_rad=0.10)
    with_band = locate_light(intensity, view, CAMERA, SQUARE, LightSearch(guard=2.0))
    without = locate_light(intensity, view, CAMERA, SQUARE, LightSearch(guard=0.0))
    off = [np.linalg.norm(found.position_rgb_m - LIGHT) for found in (with_band, without)]
    assert off[0] < 0.6 * off[1]
    assert with_band.relative_spread < without.relative_spread


def test_regions():
    intensity = np.full((120, 160), 0.3, np.float32)
    intensity[50:70, 60:80] = 0.9
    intensity[5:8, 5:8] = 0.9  # a glint: above the threshold, but not the highlight
    intensity[:, 150:] = 0.01
    usable = np.ones_like(intensity, bool)
    usable[100:] = False
    highlight, diffuse = split_regions(intensity, usable, LightSearch(guard=1.0))
    assert highlight.sum() == 400
    assert highlight[50:70, 60:80].all()
    radius = np.sqrt(400 / np.pi)
    assert not diffuse[60, 80 : 80 + int(radius)].any()
    assert diffuse[60, 80 + int(radius) + 1]
    assert not diffuse[:15, :15].any()
    assert not diffuse[:, 150:].any()
    assert not diffuse[100:].any()


def test_saturated_pixels_are_never_diffuse():
    intensity = np.full((120, 160), 0.3, np.float32)
    intensity[50:70, 60:80] = 1.0
    search = LightSearch(specular_above=0.99, diffuse_below=0.99, saturated_from=0.5, guard=0)
    intensity[20, 20:120] = 0.6
    _, diffuse = split_regions(intensity, np.ones_like(intensity, bool), search)
    assert not diffuse[20, 20:120].any()
    assert diffuse[22].all()


def test_what_cannot_be_located_is_refused():
    intensity, view, _ = board()
    with pytest.raises(InputError, match="semi-gloss"):
        locate_light(intensity * 0.1, view, CAMERA, SQUARE)
    with pytest.raises(InputError, match="are diffuse"):
        locate_light(np.maximum(intensity, 0.71), view, CAMERA, SQUARE)
    with pytest.raises(InputError, match="search's bound"):
        locate_light(intensity, view, CAMERA, SQUARE, LightSearch(farthest_m=0.3))
    with pytest.raises(InputError, match="240, 320"):
        locate_light(intensity[:10], view, CAMERA, SQUARE)


@pytest.mark.parametrize(
    "wrong", [{"diffuse_below": 0.8}, {"nearest_m": 4.0}, {"guard": -1.0}, {"specular_above": 1.0}]
)
def test_settings_are_checked(wrong):
    with pytest.raises(ConfigurationError):
        LightSearch(**wrong)
