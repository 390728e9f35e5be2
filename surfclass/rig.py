"""The sensor package as numbers: cameras, transforms, light, response, features and limits."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_validator, model_validator

from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import Capture
from surfclass.schema import Number, Positive, Table, Vector3, parse_toml, validate
from surfclass.types import Float64, Transform

SCHEMA = 1
ColourFeature = Literal["RGB", "a*b*", "K_d"]
TextureFeature = Literal["LBP", "GLCM"]

Row4 = tuple[Number, Number, Number, Number]


def _rigid(rows: tuple[Row4, ...]) -> tuple[Row4, ...]:
    Transform("dst", "src", np.array(rows))  # raises what is wrong
    return rows


Matrix4 = Annotated[tuple[Row4, Row4, Row4, Row4], AfterValidator(_rigid)]


class Camera(Table):
    """A pinhole camera; pixel (0, 0) is the centre of the top-left pixel.

    Attributes:
        size: Width and height, px.
        fx: Focal length, px. `fy` likewise; `cx`, `cy` the principal point.
        distortion: OpenCV's k1 k2 p1 p2 k3.
        vignetting: v2, v4, v6 of the relative illumination `1 + v2 r² + v4 r⁴ + v6 r⁶` with r the
            tangent of the angle to the optical axis; None where it was not calibrated.
    """

    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)
    vignetting: Vector3 | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.size[1], self.size[0]

    @property
    def matrix(self) -> Float64:
        """(3, 3) camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


class KnownTransforms(Table):
    """Rigid transforms as far as they are known; `A_T_B` takes coordinates in B to coordinates in A."""

    rgb_T_depth: Matrix4 | None = None
    flange_T_depth: Matrix4 | None = None


class Transforms(KnownTransforms):
    """Rigid transforms of a whole package."""

    rgb_T_depth: Matrix4


class Light(Table):
    """The one LED, in the `rgb` frame.

    Attributes:
        position_rgb_m: Its centre.
        axis_rgb: Unit direction of its strongest emission; None: not calibrated.
        falloff_exponent: Emission goes as cos(psi) to this power; None: not calibrated.
    """

    position_rgb_m: Vector3
    axis_rgb: Vector3 | None = None
    falloff_exponent: Annotated[Number, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _emission_is_whole(self) -> Light:
        if (self.axis_rgb is None) != (self.falloff_exponent is None):
            raise ValueError("axis_rgb and falloff_exponent go together")
        if self.axis_rgb is not None and abs(np.linalg.norm(self.axis_rgb) - 1) > 1e-6:
            raise ValueError("axis_rgb must be a unit vector")
        return self


Curve = Annotated[tuple[Number, ...], Field(min_length=2)]


class Response(Table):
    """How the camera turns irradiance into intensity, per channel R, G, B.

    Attributes:
        a2_a1_a0: The polynomial of Eq. 4.4 in metres, scaled to 1 at the training distance.
        inverse: g⁻¹ sampled at evenly spaced intensities from 0 to 1, rising from 0 to 1;
            `[[0, 1], [0, 1], [0, 1]]` is a linear camera. None: not calibrated.
    """

    a2_a1_a0: tuple[Vector3, Vector3, Vector3] | None = None
    inverse: tuple[Curve, Curve, Curve] | None = None

    @field_validator("inverse")
    @classmethod
    def _rising(cls, curves: tuple[Curve, ...] | None) -> tuple[Curve, ...] | None:
        for curve in curves or ():
            if curve[0] != 0 or curve[-1] != 1 or np.min(np.diff(curve)) <= 0:
                raise ValueError("each curve must rise strictly from 0 to 1")
        return curves


class Features(Table):
    """Which features the two routes use."""

    colour: ColourFeature = "K_d"
    texture: TextureFeature = "LBP"


class TextureLimits(Table):
    """Where texture can be trusted (Eq. 5.16–5.19); slopes are per metre and per radian."""

    near_m: Annotated[Number, Field(ge=0)] = 0.50
    far_m: Positive = 0.80
    angle_rad: Annotated[Number, Field(gt=0, le=np.pi / 2)] = 0.5236
    slope_per_m: Positive = 1000.0
    slope_per_rad: Positive = 57.2958

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> TextureLimits:
        if self.near_m >= self.far_m:
            raise ValueError(f"empty range: near_m {self.near_m} is not below far_m {self.far_m}")
        return self


class Lens(Table):
    """What the depth of field follows from (Eq. 5.1, 5.2)."""

    focal_length_m: Positive
    f_number: Positive
    focus_distance_m: Positive
    circle_of_confusion_m: Positive


class DepthCorrection(Table):
    """What the depth sensor's readings have to be corrected by (see `geometry.corrected_depth`).

    With x and y the place in the depth image, from -1 at its first column and row to 1 at its last, the
    true depth is 1 / (1 / (m(x, y) z) + inverse_offset_per_m).

    Attributes:
        multiplier: Coefficients of m by rising order, x before y: 1; x, y; x², xy, y²; x³, x²y, xy², y³.
            Their number, 1, 3, 6 or 10, says the order.
        inverse_offset_per_m: What a wrong zero of the disparity adds to the inverse depth.
    """

    multiplier: Annotated[tuple[Number, ...], Field(min_length=1)] = (1.0,)
    inverse_offset_per_m: Number = 0.0

    @field_validator("multiplier")
    @classmethod
    def _order_is_whole(cls, coefficients: tuple[float, ...]) -> tuple[float, ...]:
        if len(coefficients) not in (1, 3, 6, 10):
            raise ValueError(f"{len(coefficients)} coefficients, allowed are 1, 3, 6 or 10")
        if not 0.5 < coefficients[0] < 2:
            raise ValueError("the first coefficient is a scale, allowed is 0.5 to 2")
        return coefficients


class Arm(Table):
    """What differs between mounted VM-6083 arms.

    Attributes:
        flange_offset_m: The last D-H length (public tables disagree).
        joint_offsets_rad: What to add to each joint's read-out.
    """

    flange_offset_m: Positive = 0.084
    joint_offsets_rad: tuple[Number, Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class DepthRig(Table):
    """A sensor package as far as it is known: enough for a set without colour, or to calibrate from.

    What a table leaves out is None, and what needs it refuses with MissingCalibrationError.
    """

    schema_version: Annotated[int, Field(alias="schema")]
    name: str
    voxel_size_m: Positive
    depth: Camera
    rgb: Camera | None = None
    transforms: KnownTransforms = KnownTransforms()
    light: Light | None = None
    response: Response | None = None
    features: Features = Features()
    texture_limits: TextureLimits = TextureLimits()
    class_texture_limits: dict[str, TextureLimits] = Field(default_factory=dict)
    lens: Lens | None = None
    arm: Arm = Arm()
    depth_correction: DepthCorrection | None = None

    @field_validator("schema_version")
    @classmethod
    def _schema_is_known(cls, version: int) -> int:
        if version != SCHEMA:
            raise ValueError(f"unknown schema, allowed is {SCHEMA}")
        return version

    @cached_property
    def rgb_T_depth(self) -> Transform:
        """The depth camera in the colour camera's frame.

        Raises:
            MissingCalibrationError: If the rig has none.
        """
        if self.transforms.rgb_T_depth is None:
            raise self._lacks("transforms.rgb_T_depth")
        return Transform("rgb", "depth", np.array(self.transforms.rgb_T_depth))

    @cached_property
    def flange_T_depth(self) -> Transform:
        """The hand-eye transform.

        Raises:
            MissingCalibrationError: If the rig has none.
        """
        if self.transforms.flange_T_depth is None:
            raise MissingCalibrationError(
                f"rig {self.name}: transforms.flange_T_depth is missing, and the captures give only "
                "joint angles; add it to rig.toml, or give the captures their poses"
            )
        return Transform("flange", "depth", np.array(self.transforms.flange_T_depth))

    def check(self, capture: Capture) -> None:
        """Raises InputError where an image of the capture has not the size that the rig states.

        Where the rig has no [rgb], the images in the colour camera's grid must have one size.
        """
        in_depth = {"depth image": capture.depth.depth_mm, "IR image": capture.depth.ir}
        in_colour = {
            "colour image": None if capture.colour is None else capture.colour.rgb,
            "dark image": None if capture.dark is None else capture.dark.rgb,
            "label image": capture.label,
        }
        for images, camera in ((in_depth, self.depth), (in_colour, self.rgb)):
            found = {what: image.shape[:2] for what, image in images.items() if image is not None}
            if camera is not None:
                shape, says = camera.shape, f"rig {self.name} says"
            elif found:
                first = next(iter(found))
                shape, says = found[first], f"its {first} is"
            for what, (height, width) in found.items():
                if (height, width) != shape:
                    raise InputError(
                        f"capture {capture.name}: {what} is {width} × {height}, "
                        f"{says} {shape[1]} × {shape[0]}"
                    )

    def with_values(self, values: Mapping[str, Any]) -> DepthRig:
        """Returns the rig with some of its keys set anew.

        Args:
            values: Nested as in `rig.toml`; a table is merged key by key, anything else replaces.

        Raises:
            ConfigurationError: Naming every fault by its path.
        """
        told = merged(self.model_dump(by_alias=True, exclude_unset=True), values)
        rig = validate(DepthRig, told, f"rig {self.name}")
        return rig if rig.missing else rig.whole()

    def whole(self) -> Rig:
        """Returns the rig with its colour camera and where that is.

        Raises:
            MissingCalibrationError: Naming what of both is missing.
        """
        if self.missing:
            raise self._lacks(*self.missing)
        return Rig.model_validate(self.model_dump(by_alias=True, exclude_unset=True))

    @property
    def missing(self) -> list[str]:
        """The keys of `rig.toml` that a whole rig has and this one leaves out."""
        needed = {"[rgb]": self.rgb, "transforms.rgb_T_depth": self.transforms.rgb_T_depth}
        return [key for key, value in needed.items() if value is None]

    def _lacks(self, *keys: str) -> MissingCalibrationError:
        is_missing, it = ("is missing", "it") if len(keys) == 1 else ("are missing", "them")
        return MissingCalibrationError(
            f"rig {self.name}: {' and '.join(keys)} {is_missing}, and this step matches colour with depth; "
            f"add {it} to rig.toml (a recording keeps the rig that it was made with: import its set again)"
        )


class Rig(DepthRig):
    """The whole sensor package; read from `rig.toml`, whose text travels inside every recording."""

    rgb: Camera
    transforms: Transforms

    def whole(self) -> Rig:
        """Returns itself."""
        return self


class SurfaceClasses(Table):
    """The surface types in order, and the colour each is drawn in; label k is `names[k - 1]`."""

    names: Annotated[tuple[str, ...], Field(min_length=2, max_length=254)]
    colours: tuple[Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")], ...]

    @model_validator(mode="after")
    def _one_colour_each(self) -> SurfaceClasses:
        if len(self.colours) != len(self.names):
            raise ValueError(f"{len(self.names)} names but {len(self.colours)} colours")
        if len(set(self.names)) != len(self.names):
            raise ValueError("a name appears twice")
        return self

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """(k, 3) uint8."""
        return np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in self.colours], np.uint8)


def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Returns `old` with what `new` sets; tables are merged key by key."""
    result = dict(old)
    for key, given in new.items():
        value, below = given, result.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            value = merged(below, value)
        result[key] = value
    return result


def parse_rig(text: str | bytes, source: str) -> Rig:
    """Returns the whole rig that `rig.toml`'s text describes.

    Raises:
        ConfigurationError: Naming every fault by its path, an unknown schema among them.
        MissingCalibrationError: As `DepthRig.whole`.
    """
    return parse_depth_rig(text, source).whole()


def parse_depth_rig(text: str | bytes, source: str) -> DepthRig:
    """Returns a Rig, or a DepthRig where the text leaves out [rgb] or `transforms.rgb_T_depth`.

    Raises:
        ConfigurationError: Naming every fault by its path, an unknown schema among them.
    """
    known = parse_toml(DepthRig, text, source)
    return known if known.missing else known.whole()


def parse_classes(text: str | bytes, source: str) -> SurfaceClasses:
    """Returns the classes that `classes.toml`'s text lists.

    Raises:
        ConfigurationError: Naming every fault by its path.
    """
    return parse_toml(SurfaceClasses, text, source)
