"""What one frame shows of a plate of reflector discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfclass.types import Float64


@dataclass(frozen=True, slots=True, eq=False)
class Disc:
    """A reflector disc as one frame shows it.

    Attributes:
        pixel: (2,) where its centre is seen, in the image's own (distorted) grid.
        pixel_covariance: (2, 2) px².
        camera_m: (3,) its centre in the camera's frame.
        camera_covariance: (3, 3) m²; across the line of sight it is the pixel's, along it the plane's.
        normal: (3,) of its plane, unit, turned to the camera.
        radius_residual_m: Radius of the outline less the known one; blur makes it some tenths of a pixel.
        rms_px: Of its outline's points about the circle.
        coverage: Share of the outline that was found.
        saturated: Share of its pixels at the image's upper end.
        ring_only: Whether its plane is that of the ring around it, its own depth left out.
        outline: (n, 2) px, the fitted circle.
    """

    pixel: Float64
    pixel_covariance: Float64
    camera_m: Float64
    camera_covariance: Float64
    normal: Float64
    radius_residual_m: float
    rms_px: float
    coverage: float
    saturated: float
    ring_only: bool
    outline: Float64

    @property
    def depth_sd_m(self) -> float:
        """Standard deviation of the centre along the line of sight."""
        ray = self.camera_m / np.linalg.norm(self.camera_m)
        return float(np.sqrt(ray @ self.camera_covariance @ ray))


@dataclass(frozen=True, slots=True, eq=False)
class Rejected:
    """A bright blob that is no disc, or none that can be used.

    Attributes:
        pixel: (2,) its centre.
        reason: Why.
        outline: (n, 2) px, its border.
    """

    pixel: Float64
    reason: str
    outline: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What was found in one frame: discs from the top down, and bright blobs that are none."""

    discs: tuple[Disc, ...]
    rejected: tuple[Rejected, ...]
