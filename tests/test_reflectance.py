"""K_d by both models, its validity, and the fits behind it."""

import numpy as np
import pytest
from raycast import Plane, make_rig, pixel_rays

from surfclass.errors import InputError, MissingCalibrationError
from surfclass.reflectance import (
    LEAST_IRRADIANCE,
    UNDER_EXPOSED,
    diffuse_reflectance,
    fit_distance_polynomial,
    least_fraction,
    subtract_dark,
    well_exposed,
)
from surfclass.rig import Response
from surfclass.types import SurfaceView

LIGHT = np.array([-0.084, 0.037, -0.006])
AXIS = np.array([0.1, -0.05, 0.99]) / np.linalg.norm([0.1, -0.05, 0.99])
VIGNETTING = (-0.9, 0.4, -0.1)
SIZE = {"rgb_size": (160, 120), "rgb_f": 200.0}
GAMMA = {"R": 2.2, "G": 2.0, "B": 1.8}
CURVES = [[float(x) for x in np.linspace(0, 1, 257) ** gamma] for gamma in GAMMA.values()]


def table(**keys):
    return "{" + ", ".join(f"{key} = {value}" for key, value in keys.items()) + "}"


def full_rig(exponent=1.0, **drop):
    light = {"position_rgb_m": LIGHT.tolist(), "axis_rgb": AXIS.tolist(), "falloff_exponent": exponent}
    response = {"inverse": CURVES, "a2_a1_a0": [[0.0, 1.0, 0.0]] * 3}
    light = {k: v for k, v in light.items() if k not in drop}
    response = {k: v for k, v in response.items() if k not in drop}
    extra = f"response = {table(**response)}\n" if response else ""
    if "light" not in drop:
        extra += f"light = {table(**light)}"
    rig = make_rig(extra=extra, **SIZE)
    vignetting = None if "vignetting" in drop else VIGNETTING
    return rig.model_copy(update={"rgb": rig.rgb.model_copy(update={"vignetting": vignetting})})


def view_of(plane, rig):
    """The view of an endless plane, computed from first principles in float64."""
    ray = pixel_rays(rig.rgb)
    point = ray * plane.hit(np.zeros(3), ray)[..., None]
    away = LIGHT - point
    d = np.linalg.norm(away, axis=-1)
    normal = np.broadcast_to(np.array(plane.normal), point.shape)
    seen = np.isfinite(point).all(axis=-1)
    distance = np.linalg.norm(point, axis=-1)
    planes = [np.moveaxis(a, -1, 0).astype(np.float32) for a in (point, normal)]
    return SurfaceView(
        *planes,
        distance.astype(np.float32),
        (-(point * normal).sum(-1) / distance).astype(np.float32),
        d.astype(np.float32),
        ((away * normal).sum(-1) / d).astype(np.float32),
        seen,
        seen,
    )


def irradiance(view, rig, exponent):
    """The forward model, written out independently: light over distance, angle, LED and lens."""
    point = np.moveaxis(view.point, 0, -1).astype(np.float64)
    psi = np.clip((point - LIGHT) @ AXIS / view.light_distance_m, 0, 1)
    r = np.hypot(*np.moveaxis(pixel_rays(rig.rgb)[..., :2], -1, 0))
    lens = 1 + VIGNETTING[0] * r**2 + VIGNETTING[1] * r**4 + VIGNETTING[2] * r**6
    return view.light_cosine * psi**exponent * lens / view.light_distance_m.astype(np.float64) ** 2


K_D = np.array([0.09, 0.12, 0.16])
TILTED = Plane((np.sin(0.5), 0, -np.cos(0.5)), -0.6)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.7])
def test_full_model_recovers_a_constant_reflectance(exponent):
    rig = full_rig(exponent)
    view = view_of(TILTED, rig)
    linear = K_D[:, None, None] * irradiance(view, rig, exponent)
    response = np.array(list(GAMMA.values()))[:, None, None]
    k_d, valid = diffuse_reflectance((linear ** (1 / response)).astype(np.float32), view, rig, "full")
    assert valid.mean() > 0.6
    assert np.abs(k_d / K_D[:, None, None] - 1)[:, valid].max() < 2e-3
    # The same scene exposed half as long: the ratio of exposures makes up for it.
    half = ((linear / 2) ** (1 / response)).astype(np.float32)
    again, valid = diffuse_reflectance(half, view, rig, "full", exposure_ratio=2.0)
    assert np.abs(again / K_D[:, None, None] - 1)[:, valid].max() < 2e-3


def test_leaving_out_the_lens_or_the_led_spreads_k_d():
    rig = full_rig(1.0)
    view = view_of(TILTED, rig)
    image = np.sqrt(K_D.mean() * irradiance(view, rig, 1.0))
    image = np.stack([image] * 3).astype(np.float32)
    square = rig.response.model_copy(update={"inverse": (tuple(x * x for x in np.linspace(0, 1, 2049)),) * 3})
    rig = rig.model_copy(update={"response": square})
    no_lens = rig.model_copy(update={"rgb": rig.rgb.model_copy(update={"vignetting": (0.0, 0.0, 0.0)})})
    no_led = rig.model_copy(update={"light": rig.light.model_copy(update={"falloff_exponent": 0.0})})

    def variation(chosen):
        k_d, valid = diffuse_reflectance(image, view, chosen, "full")
        return k_d[0][valid].std() / k_d[0][valid].mean()

    assert variation(rig) < 1e-3
    assert variation(no_lens) > 0.03
    assert variation(no_led) > 0.01


def straight_view(angle_deg, d):
    """Four pixels at one distance and one incidence angle."""
    one = np.ones((2, 2), np.float32)
    point = np.zeros((3, 2, 2), np.float32)
    point[:] = (LIGHT + d * np.array([0, 0, 1.0]))[:, None, None]
    cosine = one * np.float32(np.cos(np.radians(angle_deg)))
    seen = np.ones((2, 2), bool)
    return SurfaceView(point, point * 0, one, one, one * np.float32(d), cosine, seen, seen)


@pytest.mark.parametrize(("angle", "excess"), [(0, 0.0), (45, 0.19), (60, 0.41)])
def test_printed_4_12_overestimates_off_the_normal(angle, excess):
    """With g = √ the polynomial (0, 1, 0) fits every distance at 0° and is 41 % too high at 60°."""
    rig = make_rig(
        extra=f"response = {table(a2_a1_a0=[[0.0, 1.0, 0.0]] * 3)}\n"
        f"light = {table(position_rgb_m=LIGHT.tolist())}",
        **SIZE,
    )
    values, full_values = [], []
    for theta in (0.0, angle - 1e-3 if angle else 0.0):
        for d in (0.6, 1.1):
            view = straight_view(theta, d)
            image = np.sqrt(0.1 * np.cos(np.radians(theta)) / d**2) * np.ones((3, 2, 2))
            k_d, valid = diffuse_reflectance(image.astype(np.float32), view, rig, "thesis")
            assert valid.all()
            values.append(k_d.mean())
            full_values.append((image**2 * d**2 / np.cos(np.radians(theta))).mean())
    assert values[1] == pytest.approx(values[0], rel=1e-5)  # distance alone is right
    assert values[2] / values[0] - 1 == pytest.approx(excess, abs=0.005)
    assert full_values[2] == pytest.approx(full_values[0], rel=1e-9)


def test_full_model_is_right_where_the_printed_one_is_41_percent_high():
    rig = full_rig(0.0)
    flat = {"vignetting": (0.0, 0.0, 0.0)}
    square = tuple(x * x for x in np.linspace(0, 1, 2049).tolist())
    rig = rig.model_copy(
        update={
            "rgb": rig.rgb.model_copy(update=flat),
            "response": rig.response.model_copy(update={"inverse": (square,) * 3}),
        }
    )
    ratio = {}
    for mode in ("thesis", "full"):
        k_d = []
        for theta in (0.0, 59.999):
            image = np.sqrt(0.1 * np.cos(np.radians(theta)) / 0.8**2) * np.ones((3, 120, 160))
            view = straight_view(theta, 0.8)
            view = SurfaceView(
                *[
                    np.broadcast_to(a[..., :1, :1], (*a.shape[:-2], 120, 160))
                    for a in (getattr(view, name) for name in SurfaceView.__slots__)
                ]
            )
            values, valid = diffuse_reflectance(image.astype(np.float32), view, rig, mode)
            k_d.append(values[:, valid].mean())
        ratio[mode] = k_d[1] / k_d[0]
    assert ratio["full"] == pytest.approx(1, abs=1e-3)
    assert ratio["thesis"] == pytest.approx(np.sqrt(2), abs=1e-3)


def test_invalid_pixels_are_marked_and_zero():
    rig = full_rig()
    view = view_of(TILTED, rig)
    image = np.full((3, 120, 160), 0.4, np.float32)
    image[2, 10, 10] = 0.01
    image[0, 10, 11] = 0.99
    has_normal = view.has_normal.copy()
    has_normal[10, 12] = False
    cosine = view.light_cosine.copy()
    cosine[10, 13] = np.cos(np.radians(60.1))
    cosine[10, 14] = np.cos(np.radians(59.9))
    cosine[10, 15] = -0.7
    view = SurfaceView(
        view.point,
        view.normal,
        view.viewing_distance_m,
        view.viewing_cosine,
        view.light_distance_m,
        cosine,
        view.has_point,
        has_normal,
    )
    for mode in ("thesis", "full"):
        k_d, valid = diffuse_reflectance(image, view, rig, mode)
        assert (k_d.dtype, valid.dtype) == (np.float32, bool)
        assert not valid[10, [10, 11, 12, 13, 15]].any()
        assert valid[10, [9, 14]].all()
        assert np.isfinite(k_d).all()
        assert not k_d[:, ~valid].any()
        assert (k_d[:, valid] > 0).all()


def test_what_lies_behind_the_light_is_invalid():
    rig = full_rig()
    backwards = rig.light.model_copy(update={"axis_rgb": (0.0, 0.0, -1.0)})
    image = np.full((3, 120, 160), 0.4, np.float32)
    view = view_of(TILTED, rig)
    k_d, valid = diffuse_reflectance(image, view, rig.model_copy(update={"light": backwards}), "full")
    assert not valid.any()
    assert not k_d.any()


@pytest.mark.parametrize(
    ("mode", "drop", "named"),
    [
        ("thesis", ["light"], "light.position_rgb_m"),
        ("thesis", ["a2_a1_a0"], "response.a2_a1_a0"),
        ("full", ["inverse"], "response.inverse"),
        ("full", ["inverse", "a2_a1_a0"], "response.inverse"),
        ("full", ["vignetting"], "rgb.vignetting"),
        ("full", ["axis_rgb", "falloff_exponent"], "light.axis_rgb"),
    ],
)
def test_missing_calibrations_are_named(mode, drop, named):
    whole = full_rig()
    rig = full_rig(**dict.fromkeys(drop, True))
    with pytest.raises(MissingCalibrationError, match=f"{named}.* add .* to rig.toml"):
        diffuse_reflectance(np.full((3, 120, 160), 0.4, np.float32), view_of(TILTED, whole), rig, mode)


def test_other_faults_of_the_call():
    rig, image = full_rig(), np.full((3, 120, 160), 0.4, np.float32)
    view = view_of(TILTED, rig)
    with pytest.raises(InputError, match="120, 160"):
        diffuse_reflectance(image[:, :60], view, rig, "full")
    with pytest.raises(InputError, match="one exposure"):
        diffuse_reflectance(image, view, rig, "thesis", exposure_ratio=2.0)
    with pytest.raises(InputError, match="allowed are"):
        diffuse_reflectance(image, view, rig, "other")


def test_well_exposed_looks_at_every_channel():
    image = np.full((3, 1, 4), 0.5, np.float32)
    image[0, 0, 1], image[1, 0, 2], image[2, 0, 3] = 0.02, 0.98, 0.0
    assert well_exposed(image).tolist() == [[True, False, False, False]]


def test_a_deep_linear_image_is_under_exposed_by_its_light_and_not_by_its_fraction():
    linear = Response(inverse=((0.0, 1.0),) * 3)
    level = np.linspace(0, 1, 256)
    srgb = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    encoded = Response(inverse=(tuple(srgb.tolist()),) * 3)
    assert least_fraction(linear, 16) == pytest.approx(LEAST_IRRADIANCE)
    assert least_fraction(encoded, 16) == pytest.approx(UNDER_EXPOSED, abs=0.001)
    for response, bits in ((linear, 8), (None, 16), (Response(a2_a1_a0=((1.0, 0.0, 0.0),) * 3), 16)):
        assert least_fraction(response, bits) == UNDER_EXPOSED


def test_polynomial_of_a_square_root_response_is_linear():
    """The case study's 0, 1, 0: 1/I of a √ response is proportional to the distance."""
    d = np.linspace(0.65, 1.3, 8)
    a2, a1, a0 = fit_distance_polynomial(d, np.sqrt(0.2 / d**2), reference_m=0.65)
    assert (a2, a0) == (pytest.approx(0, abs=1e-9), pytest.approx(0, abs=1e-9))
    assert a1 == pytest.approx(1 / 0.65)
    a2, a1, a0 = fit_distance_polynomial(d, 0.2 / d**2, reference_m=1.0)
    assert (a2, a1, a0) == pytest.approx((1, 0, 0), abs=1e-9)


def test_fit_is_weighted_so_that_relative_errors_count_alike():
    """With a model error and noise in I, unweighted least squares of 1/I gives the dark end all the say."""
    rng = np.random.default_rng(3)
    d = np.linspace(0.4, 2.5, 40)
    clean = 0.3 / d**2
    weighted_error, printed_error = [], []
    for _ in range(40):
        noisy = clean + rng.normal(0, 0.004, d.size)
        weighted = np.array(fit_distance_polynomial(d, noisy, 1.0))
        printed = np.polyfit(d, 1 / noisy, 2)
        printed = printed / np.polyval(printed, 1.0)
        for coefficients, errors in ((weighted, weighted_error), (printed, printed_error)):
            errors.append(np.sqrt(np.mean((np.polyval(coefficients, d) / d**2 - 1) ** 2)))
    assert np.median(weighted_error) < 0.7 * np.median(printed_error)


@pytest.mark.parametrize(
    ("d", "i"),
    [
        ([0.5, 1.0], [0.4, 0.1]),
        ([0.5, 1.0, 1.0], [0.4, 0.1, 0.1]),
        ([0.5, 0.8, 1.0], [0.4, 0.0, 0.1]),
        ([0.5, 0.8, np.nan], [0.4, 0.2, 0.1]),
        ([0.5, 0.8, 1.0], [0.4, 0.2]),
        ([1.0, 1.1, 1.2], [0.2, 0.01, 0.2]),
    ],
)
def test_polynomial_refuses_samples_that_do_not_determine_it(d, i):
    with pytest.raises(InputError, match="distance polynomial"):
        fit_distance_polynomial(np.array(d), np.array(i), 0.65 if d[0] < 1 else 5.0)


def response(gamma=2.0):
    curve = tuple(float(x) for x in np.linspace(0, 1, 513) ** gamma)
    return Response(inverse=(curve, curve, curve))


@pytest.mark.parametrize(("kind", "full", "step"), [(np.uint8, 255, 1), (np.uint16, 65535, 60)])
def test_ambient_light_is_taken_off_before_the_response(kind, full, step):
    rng = np.random.default_rng(0)
    led, ambient = rng.uniform(0.05, 0.6, (2, 20, 30, 3))

    def camera(linear):
        return np.rint(np.sqrt(linear) * full).astype(kind)

    result = subtract_dark(camera(led + ambient * 0.5), camera(ambient * 0.5), response())
    assert result.dtype == kind
    assert np.abs(result.astype(int) - camera(led)).max() <= 5 * step
    naive = camera(led + ambient * 0.5).astype(int) - camera(ambient * 0.5)
    assert np.abs(naive - camera(led)).mean() > 20 * full / 255


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_saturation_survives_the_subtraction_and_darkness_ends_at_zero(kind):
    full = np.iinfo(kind).max
    lit = np.array([[[full, full // 4, 100]]], kind)
    dark = np.array([[[full // 2, full // 3, 0]]], kind)
    assert subtract_dark(lit, dark, response(1.0)).ravel().tolist() == [full, 0, 100]


@pytest.mark.parametrize(("kind", "dark_kind"), [(np.uint16, np.uint8), (np.uint8, np.uint16)])
def test_bit_depths_may_differ(kind, dark_kind):
    """Full scale is the same light at either depth: 8 bit times 257 is the very same fraction."""
    rng = np.random.default_rng(1)
    lit, dark = rng.integers(0, 256, (2, 20, 30, 3)).astype(np.uint8)
    image = lit.astype(kind) * kind(np.iinfo(kind).max // 255)
    alike, other = (dark.astype(each) * each(np.iinfo(each).max // 255) for each in (kind, dark_kind))
    result = subtract_dark(image, other, response())
    assert result.dtype == kind
    assert result.tolist() == subtract_dark(image, alike, response()).tolist()
    assert (result != image).mean() > 0.9


def test_subtraction_needs_the_response_and_equal_images():
    image = np.zeros((2, 2, 3), np.uint8)
    for lacking in (None, Response()):
        with pytest.raises(
            MissingCalibrationError, match=r"dark frame cannot be subtracted without .*to rig\.toml"
        ):
            subtract_dark(image, image, lacking)
    with pytest.raises(InputError, match="dark image"):
        subtract_dark(image, image.astype(np.float32), response())
    with pytest.raises(InputError, match="dark image"):
        subtract_dark(image, image[:1], response())
