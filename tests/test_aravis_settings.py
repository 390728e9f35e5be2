"""Setting up GenICam cameras of other makes: features missing, locked, stubborn or by other names."""

from __future__ import annotations

import pytest

from drivers.aravis.formats import best, parse
from drivers.aravis.library import GenicamError
from drivers.aravis.options import AravisOptions
from drivers.aravis.settings import set_up
from drivers.bayer import demosaic, mosaic
from drivers.errors import DeviceFaultError
from surfclass.errors import ConfigurationError, InputError

GONE = 5


class Camera:
    """A camera of features in a dict; `aravis_library.Camera` without Aravis.

    Args:
        features: Values by name; a value's type is the feature's.
        choices: Entries of the enumerations.
        bounds: Of numbers.
        stuck: Features that take any value and keep their own.
        locked: Features whose writing fails, with a code.
        steps: Increments of integers.
    """

    def __init__(self, features, choices=None, bounds=None, stuck=(), locked=None, steps=None):
        self.features, self.stuck, self.locked = dict(features), set(stuck), dict(locked or {})
        self.entries, self.limits, self.steps = choices or {}, bounds or {}, steps or {}
        self.written = []

    def has(self, feature):
        return feature in self.features

    def kind(self, feature):
        names = {bool: "boolean", int: "integer", float: "float", str: "text"}
        return names[type(self.features[feature])]

    def read(self, feature):
        if feature not in self.features:
            raise GenicamError(f"[{feature}] Not found", 1)
        return self.features[feature]

    def write(self, feature, value):
        if feature in self.locked:
            raise GenicamError(f"[{feature}] is locked", self.locked[feature])
        self.written.append(feature)
        if feature not in self.stuck:
            self.features[feature] = type(self.features[feature])(value)

    def bounds(self, feature):
        return self.limits.get(feature, (0, 1e6))

    def step(self, feature):
        return self.steps.get(feature, 1)

    def choices(self, feature):
        return tuple(self.entries.get(feature, ()))


PLAIN = {"Width": 640, "Height": 480, "PixelFormat": "Mono8", "ExposureTime": 100.0, "Gain": 3.0}
TRIGGERS = {"TriggerSelector": "FrameStart", "TriggerMode": "Off", "TriggerSource": "Line0"}
CHOICES = {
    "PixelFormat": ("Mono8", "BayerGB8"),
    "TriggerSelector": ("FrameStart",),
    "TriggerSource": ("Line0", "Software"),
}
BOUNDS = {"Width": (16, 640), "Height": (16, 480)}


def camera(*, without=(), choices=None, bounds=None, stuck=(), locked=None, steps=None, **features):
    features = {
        name: value for name, value in {**PLAIN, **TRIGGERS, **features}.items() if name not in without
    }
    return Camera(
        features, {**CHOICES, **(choices or {})}, {**BOUNDS, **(bounds or {})}, stuck, locked, steps
    )


def done(made, **options):
    return set_up(made, AravisOptions(**options), "colour")


def test_a_camera_with_few_features_is_set_up_with_what_it_has():
    made = camera()
    setup = done(made, exposure_us=5000.0, gain_db=6.0)
    assert setup.format.name == "BayerGB8"
    assert (setup.size, setup.exposure_s, setup.gain_db) == ((640, 480), 0.005, 6.0)
    assert made.features["TriggerMode"] == "On"
    assert made.features["TriggerSource"] == "Software"


@pytest.mark.parametrize(
    ("feature", "automatic", "off"),
    [
        ("ExposureAuto", "Continuous", "Off"),
        ("GainAuto", "Once", "Off"),
        ("BalanceWhiteAuto", "Continuous", "Off"),
        ("BlackLevelAuto", "Continuous", "Off"),
        ("GammaEnable", True, False),
        ("GammaEnabled", True, False),
        ("Gamma", 0.45, 1.0),
        ("SharpeningEnable", True, False),
        ("SharpnessEnabled", True, False),
        ("SaturationEnable", True, False),
        ("SaturationEnable", "On", "Off"),
        ("ColorTransformationEnable", True, False),
        ("LUTEnable", True, False),
        ("ReverseX", True, False),
        ("BinningVertical", 2, 1),
        ("DecimationHorizontal", 4, 1),
        ("TestPattern", "Ramp", "Off"),
        ("AcquisitionFrameRateEnable", True, False),
    ],
)
def test_what_changes_the_image_by_itself_is_off_or_the_camera_is_refused(feature, automatic, off):
    made = camera(**{feature: automatic})
    done(made)
    assert made.features[feature] == off
    with pytest.raises(DeviceFaultError, match=f"{feature}: wanted {off!r}, it reads {automatic!r}"):
        done(camera(stuck=[feature], **{feature: automatic}))
    with pytest.raises(DeviceFaultError, match=rf"{feature}: .*\[{feature}\] is locked"):
        done(camera(locked={feature: 0}, **{feature: automatic}))
    done(camera(locked={feature: 0}, **{feature: off}))  # it is off already


def test_gamma_is_left_alone_where_it_has_a_switch():
    made = camera(GammaEnable=True, Gamma=0.8, locked={"Gamma": 0})
    done(made)
    assert made.features["GammaEnable"] is False


def test_a_setting_that_another_one_undoes_is_noticed():
    class Undoing(Camera):
        def write(self, feature, value):
            super().write(feature, value)
            if feature == "ExposureTime":
                self.features["GainAuto"] = "Continuous"

    made = camera(GainAuto="Continuous")
    made.__class__ = Undoing
    with pytest.raises(DeviceFaultError, match="GainAuto: was 'Off', and reads 'Continuous' after all"):
        done(made, exposure_us=7000.0)


def test_a_camera_that_stops_answering_is_no_fault_of_a_feature():
    with pytest.raises(GenicamError) as caught:
        done(camera(GainAuto="Once", locked={"GainAuto": GONE}))
    assert caught.value.gone


@pytest.mark.parametrize(("took", "accepted"), [(5012.0, True), (5200.0, False)])
def test_the_nearest_exposure_that_a_camera_can_make_is_taken_and_told(took, accepted):
    class Rounding(Camera):
        def write(self, feature, value):
            super().write(feature, took if feature == "ExposureTime" else value)

    made = camera()
    made.__class__ = Rounding
    if accepted:
        assert done(made, exposure_us=5000.0).exposure_s == took / 1e6
    else:
        with pytest.raises(DeviceFaultError, match=r"ExposureTime: wanted 5000\.0, it reads 5200\.0"):
            done(made, exposure_us=5000.0)


def test_older_names_are_known():
    made = camera(
        without=["ExposureTime", "Gain"], ExposureTimeAbs=1.0, GainRaw=200, bounds={"GainRaw": (4, 500)}
    )
    setup = done(made, exposure_us=5000.0)
    assert setup.exposure_feature == "ExposureTimeAbs"
    assert setup.gain_db is None
    assert made.features["GainRaw"] == 4
    with pytest.raises(ConfigurationError, match=r"gain_db 3: .* allowed is 0"):
        done(camera(without=["Gain"], GainRaw=4), gain_db=3.0)


def test_white_balance_is_neutral_or_as_configured_for_each_colour():
    class Selecting(Camera):
        ratios = None

        def read(self, feature):
            if feature == "BalanceRatio":
                return self.ratios[self.features["BalanceRatioSelector"]]
            return super().read(feature)

        def write(self, feature, value):
            if feature == "BalanceRatio":
                self.ratios[self.features["BalanceRatioSelector"]] = value
            super().write(feature, value)

    made = camera(
        BalanceRatioSelector="Red", BalanceRatio=1.0, choices={"BalanceRatioSelector": ("Red", "Blue")}
    )
    made.__class__ = Selecting
    made.ratios = {"Red": 1.4, "Blue": 1.9}
    assert "white balance red 1.000, blue 1.250" in done(made, balance_blue=1.25).facts
    assert made.ratios == {"Red": 1.0, "Blue": 1.25}
    with pytest.raises(ConfigurationError, match="white balance is fixed"):
        done(camera(), balance_red=1.2)


@pytest.mark.parametrize(
    ("made", "options", "message"),
    [
        (camera(choices={"PixelFormat": ("Mono8", "YUV422Packed")}), {}, "no colour format .* Mono8, YUV422"),
        (camera(without=["ExposureTime"]), {}, "exposure_us: .* no ExposureTime or ExposureTimeAbs"),
        (camera(without=["TriggerMode", "TriggerSource"]), {}, "trigger: this camera has no TriggerMode"),
        (
            camera(choices={"TriggerSource": ("Line0",)}),
            {},
            "trigger 'software'|'Software', this camera has Line0",
        ),
        (camera(), {"strobe_lines": ["Line2"]}, "strobe_lines: this camera has no LineSelector"),
        (camera(), {"region": (8, 0, 16, 16)}, "this camera has no OffsetX"),
        (camera(OffsetX=0, OffsetY=0), {"region": (1, 0, 16, 16)}, "OffsetX 1, must be even"),
        (camera(), {"region": (0, 0, 640, 500)}, "leaves the 640 × 480"),
        (
            camera(steps={"Width": 16}),
            {"region": (0, 0, 40, 16)},
            "Width 40, this camera takes multiples of 16",
        ),
        (camera(), {"trigger": "free", "rate_hz": 5.0}, "rate_hz: .* no AcquisitionFrameRate"),
    ],
)
def test_what_a_camera_has_not_is_said(made, options, message):
    with pytest.raises(ConfigurationError, match=message):
        done(made, **options)


def test_a_packed_format_needs_whole_groups_of_pixels():
    made = camera(choices={"PixelFormat": ("BayerRG10p",)})
    with pytest.raises(ConfigurationError, match=r"region: width 18 .* multiple of 4"):
        done(made, region=(0, 0, 18, 16))


def test_a_camera_without_any_trigger_can_run_freely():
    made = camera(without=["TriggerMode", "TriggerSource", "TriggerSelector"])
    assert done(made, trigger="free").trigger == "free"


def test_strobe_lines_are_made_outputs_one_by_one():
    class Lines(Camera):
        lines = None

        def write(self, feature, value):
            super().write(feature, value)
            if feature != "LineSelector" and feature.startswith("Line"):
                self.lines[self.features["LineSelector"], feature] = value

    made = camera(
        LineSelector="Line0",
        LineMode="Input",
        LineSource="Off",
        LineInverter=False,
        choices={
            "LineSelector": ("Line0", "Line1"),
            "LineMode": ("Input", "Output"),
            "LineSource": ("Off", "ExposureActive"),
        },
    )
    made.__class__ = Lines
    made.lines = {}
    facts = done(made, strobe_lines=["Line1"], strobe_inverted=True).facts
    assert "strobe on Line1: ExposureActive, inverted" in facts
    assert made.lines == {
        ("Line1", "LineMode"): "Output",
        ("Line1", "LineSource"): "ExposureActive",
        ("Line1", "LineInverter"): True,
    }
    made.stuck.add("LineSource")
    made.features["LineSource"] = "Off"
    with pytest.raises(DeviceFaultError, match="Line1: LineSource: wanted 'ExposureActive', it reads 'Off'"):
        done(made, strobe_lines=["Line1"])


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (("Mono8", "RGB8", "BayerRG8"), "BayerRG8"),
        (("BayerGR8", "BayerGR16", "BayerGR12p", "BayerGR12"), "BayerGR12"),
        (("BayerGR8", "BayerGR16", "BayerGR12Packed"), "BayerGR12Packed"),
        (("BayerBG8", "BayerBG16"), "BayerBG16"),
        (("Mono8", "BGR8", "YUV422_8"), "BGR8"),
        (("Mono8", "Mono16", "BayerXY8", "BayerRG9"), None),
    ],
)
def test_the_best_format_is_raw_and_deep(names, chosen):
    found = best(names)
    assert (found and found.name) == chosen


@pytest.mark.parametrize(
    ("name", "pattern"),
    [("BayerRG8", "RGGB"), ("BayerGR8", "GRBG"), ("BayerGB8", "GBRG"), ("BayerBG8", "BGGR")],
)
def test_a_format_name_gives_the_first_row_of_its_pattern(name, pattern):
    import numpy as np

    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    raw = mosaic(image, pattern)
    assert np.array_equal(parse(name).rgb(raw.tobytes(), 8, 6), demosaic(raw, pattern, 8))


def test_blue_first_is_turned_round():
    assert parse("BGR8").rgb(bytes([1, 2, 3, 4, 5, 6]), 2, 1).tolist() == [[[3, 2, 1], [6, 5, 4]]]


@pytest.mark.parametrize("name", ["BayerRG8", "BayerRG12", "BayerRG12p", "RGB8"])
def test_content_of_another_size_is_refused(name):
    one = parse(name)
    with pytest.raises(InputError, match="bytes"):
        one.rgb(bytes(one.frame_bytes(8, 6) - 1), 8, 6)
