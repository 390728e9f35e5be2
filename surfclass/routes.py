"""The two routes from an image to class posteriors: colour, pixel by pixel, and texture, window by window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surfclass import colour, reflectance, texture
from surfclass.classifiers.naive_bayes import NaiveBayes
from surfclass.classifiers.svm import Svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.rig import ColourFeature, Rig, TextureFeature
from surfclass.types import Bool, Float32, Posterior, SurfaceView

Image = NDArray[np.uint8] | NDArray[np.uint16]
Classifier = Svm | NaiveBayes
ReflectanceMode = Literal["thesis", "full"]


def colour_features(
    feature: ColourFeature,
    image: Image,
    view: SurfaceView,
    rig: Rig,
    mode: ReflectanceMode,
    exposure_ratio: float = 1.0,
) -> tuple[Float32, Bool]:
    """Returns the colour features of every pixel and where they can be used.

    Args:
        feature: "RGB" (fractions of full scale), "a*b*" (Eq. 4.20, 4.21) or "K_d" (Eq. 4.12).
        image: (h, w, 3), in the camera's own response.
        view: The geometry of the same pixels; only K_d looks at it.
        rig: Its light, response and vignetting; only K_d looks at them.
        mode: How K_d is computed.
        exposure_ratio: Reference exposure over this image's; only the full model can use it.

    Returns:
        (d, h, w) float32 features and (h, w) bool.

    Raises:
        MissingCalibrationError: If K_d needs a calibration that the rig does not have.
        InputError: If K_d is to be scaled in thesis mode.
    """
    fraction = colour.as_fraction(image)
    if feature == "K_d":
        bits = 8 * image.dtype.itemsize
        return reflectance.diffuse_reflectance(fraction, view, rig, mode, exposure_ratio, bits)
    everywhere = np.ones(image.shape[:2], bool)
    return (fraction if feature == "RGB" else colour.a_b(fraction)), everywhere


def texture_features(
    feature: TextureFeature, image: Image, window_px: int, stride_px: int | None = None
) -> Float32:
    """Returns (rows, cols, d) texture features of the windows of a (h, w, 3) image.

    Windows are whole and start every `stride_px` (default: side by side).
    """
    grey = texture.grey_levels(image)
    stride = window_px if stride_px is None else stride_px
    if feature == "LBP":
        return texture.lbp_histograms(grey, window_px, stride=stride)
    return texture.glcm_features(grey, window_px, stride=stride).astype(np.float32)


def exposure_ratio(trained_s: float | None, exposure_s: float | None) -> float:
    """Returns the training exposure over this one, which K_d is scaled by; 1 where either is unknown."""
    return 1.0 if trained_s is None or exposure_s is None else trained_s / exposure_s


@dataclass(frozen=True, slots=True, eq=False)
class ColourRoute:
    """A trained colour classifier.

    Attributes:
        feature: What it was trained on.
        reflectance: How its K_d was computed; without meaning for other features.
        exposure_s: Exposure of its first training image, which K_d is scaled to; None: not known.
        classifier: The exact classifier.
        table: Its posteriors tabulated, which is what frames are classified with; None for a
            classifier that is evaluated directly.
    """

    feature: ColourFeature
    reflectance: ReflectanceMode
    exposure_s: float | None
    classifier: Classifier
    table: PosteriorTable | None

    def classify(
        self, image: Image, view: SurfaceView, rig: Rig, exposure_s: float | None = None
    ) -> Posterior:
        """Returns the class distribution of every pixel of a (h, w, 3) image.

        Raises:
            MissingCalibrationError: As `colour_features`.
            InputError: If K_d is wanted at another exposure than the classifier was trained at, and
                the printed polynomial, which cannot account for it, is in use.
        """
        ratio = exposure_ratio(self.exposure_s, exposure_s)
        features, valid = colour_features(self.feature, image, view, rig, self.reflectance, ratio)
        flat = features.reshape(len(features), -1)
        usable = valid.reshape(-1)
        everywhere = bool(usable.all())
        rows = np.flatnonzero(usable)
        chosen = flat if everywhere else flat.take(rows, axis=1, mode="clip")
        rejected = np.zeros(usable.shape, bool)
        if self.table is not None:
            found = self.table.lookup(chosen)
        else:
            found = self.classifier.posterior(chosen.T.astype(np.float64)).astype(np.float32)
            if isinstance(self.classifier, NaiveBayes):
                rejected[rows] = self.classifier.rejects(chosen.T.astype(np.float64))
        if everywhere:
            probability = found
        else:
            probability = np.zeros((usable.size, found.shape[1]), np.float32)
            probability[rows] = found
        if rejected.any():
            probability[rejected] = 0
        shape = image.shape[:2]
        return Posterior(
            probability=probability.reshape(*shape, -1),
            valid=(usable & ~rejected).reshape(shape),
            rejected=rejected.reshape(shape),
        )


@dataclass(frozen=True, slots=True, eq=False)
class TextureRoute:
    """A trained texture classifier and the side of its windows."""

    feature: TextureFeature
    window_px: int
    classifier: Classifier

    def classify(self, image: Image) -> Posterior:
        """Returns the class distribution of every whole window of a (h, w, 3) image."""
        features = texture_features(self.feature, image, self.window_px)
        rows, cols, d = features.shape
        flat = features.reshape(-1, d).astype(np.float64)
        probability = self.classifier.posterior(flat).astype(np.float32)
        rejected = np.zeros(rows * cols, bool)
        if isinstance(self.classifier, NaiveBayes):
            rejected = self.classifier.rejects(flat)
            probability[rejected] = 0
        return Posterior(
            probability=probability.reshape(rows, cols, -1),
            valid=~rejected.reshape(rows, cols),
            rejected=rejected.reshape(rows, cols),
            cell_px=self.window_px,
        )
