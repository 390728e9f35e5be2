"""Training: labelled captures become a Model; samples are held out by place, never by pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surfclass import reflectance
from surfclass.classifiers import naive_bayes, svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.colour import as_fraction
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import Capture
from surfclass.model import Model, with_polynomial
from surfclass.pipeline import lit_image, naming
from surfclass.rig import ColourFeature, Rig, SurfaceClasses
from surfclass.routes import (
    Classifier,
    ColourRoute,
    Image,
    ReflectanceMode,
    TextureRoute,
    colour_features,
    exposure_ratio,
    texture_features,
)
from surfclass.types import Float64
from surfclass.viewing import view_surface

Note = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How a model is trained.

    Attributes:
        classifier: "svm" (RBF for colour, linear for texture), or "naive_bayes".
        reflectance: How K_d is computed; None takes the full model where the rig has what it
            needs, else the printed polynomial.
        pixels_per_class: Colour samples of each class, drawn evenly from its captures.
        windows_per_class: Texture samples of each class.
        window_px: Side of a texture window.
        place_px: Side of the square of pixels that is one place for hold-out.
        C: SVM's penalty.
        gamma: RBF's width, for standardised features.
        folds: Of the hold-out that the posteriors are fitted on.
        seed: Of the drawing and the folds.
    """

    classifier: Literal["svm", "naive_bayes"] = "svm"
    reflectance: ReflectanceMode | None = None
    pixels_per_class: int = 1500
    windows_per_class: int = 1000
    window_px: int = 20
    place_px: int = 80
    C: float = 10.0
    gamma: float = 1.0
    folds: int = 5
    seed: int = 0


@dataclass(slots=True)
class _Samples:
    """Samples of one route as they are gathered, capture by capture."""

    values: list[Float64] = field(default_factory=list)
    labels: list[NDArray[np.intp]] = field(default_factory=list)
    places: list[NDArray[np.intp]] = field(default_factory=list)

    def add(self, values: NDArray[Any], label: int, places: NDArray[Any]) -> None:
        self.values.append(values.astype(np.float64))
        self.labels.append(np.full(len(values), label, np.intp))
        self.places.append(places.astype(np.intp))

    def drawn(
        self, per_class: int, rng: np.random.Generator
    ) -> tuple[Float64, NDArray[np.intp], NDArray[np.intp]]:
        """At most `per_class` samples of each class, drawn without replacement."""
        values, labels = np.concatenate(self.values), np.concatenate(self.labels)
        places = np.concatenate(self.places)
        chosen = []
        for label in np.unique(labels):
            rows = np.flatnonzero(labels == label)
            chosen.append(rows if len(rows) <= per_class else rng.choice(rows, per_class, replace=False))
        rows = np.sort(np.concatenate(chosen))
        return values[rows], labels[rows], places[rows]


def train(
    captures: Iterable[Capture],
    response_captures: Iterable[Capture],
    rig: Rig,
    classes: SurfaceClasses,
    settings: TrainingSettings | None = None,
    note: Note = lambda _: None,
) -> Model:
    """Returns a model with a colour route for every feature that the rig allows, and a texture route.

    Args:
        captures: Labelled captures of role "train"; one at a time is held in memory.
        response_captures: Captures of role "response"; used only where K_d is wanted in thesis
            mode and the rig has no polynomial.
        rig: The sensor package.
        classes: What the labels mean.
        settings: See TrainingSettings.
        note: Called with a sentence at each step.

    Raises:
        InputError: If there is no labelled capture, or a class has no sample.
        MissingCalibrationError: If K_d is the rig's colour feature and cannot be computed.
    """
    settings = settings or TrainingSettings()
    mode = _reflectance_mode(rig, settings, note)
    fitted = None
    if mode == "thesis" and (rig.response is None or rig.response.a2_a1_a0 is None):
        try:
            fitted = fit_response(response_captures, rig)
        except MissingCalibrationError as error:
            if rig.features.colour == "K_d":
                raise
            note(f"the K_d route is left out: {error}")
            mode = None
        else:
            note("fitted the polynomial of Eq. 4.4 to the response captures")
            rig = with_polynomial(rig, fitted)
    features: list[ColourFeature] = ["RGB", "a*b*"] if mode is None else ["RGB", "a*b*", "K_d"]

    gathered = _gather(captures, features, rig, len(classes.names), mode or "thesis", settings, note)
    rng = np.random.default_rng(settings.seed)
    colour: dict[ColourFeature, ColourRoute] = {}
    for feature in features:
        note(f"training the {feature} route")
        drawn = gathered.colour[feature].drawn(settings.pixels_per_class, rng)
        _every_class_has_samples(
            drawn[1], classes, f"{feature} pixel (K_d needs a normal and a good exposure)"
        )
        classifier = _fit(*drawn, "rbf", settings)
        table = _tabulate(classifier, drawn[0]) if isinstance(classifier, svm.Svm) else None
        colour[feature] = ColourRoute(feature, mode or "thesis", gathered.exposure_s, classifier, table)
    note(f"training the {rig.features.texture} route")
    drawn = gathered.texture.drawn(settings.windows_per_class, rng)
    side = settings.window_px
    _every_class_has_samples(drawn[1], classes, f"window of {side} × {side} px that is all of one label")
    texture = TextureRoute(rig.features.texture, settings.window_px, _fit(*drawn, "linear", settings))
    card = {
        "settings": asdict(settings),
        "rig": rig.name,
        "captures": gathered.names,
        "reflectance": mode,
        "exposure_s": gathered.exposure_s,
    }
    return Model(classes, colour, texture, fitted, card)


@dataclass(slots=True)
class _Gathered:
    """What one pass over the training captures leaves."""

    colour: dict[ColourFeature, _Samples]
    texture: _Samples = field(default_factory=_Samples)
    names: list[str] = field(default_factory=list)
    exposure_s: float | None = None


def _gather(
    captures: Iterable[Capture],
    features: list[ColourFeature],
    rig: Rig,
    class_count: int,
    mode: ReflectanceMode,
    settings: TrainingSettings,
    note: Note,
) -> _Gathered:
    rng = np.random.default_rng(settings.seed)
    gathered = _Gathered({feature: _Samples() for feature in features})
    for number, capture in enumerate(captures):
        rig.check(capture)
        if capture.label is None or capture.colour is None:
            raise InputError(f"capture {capture.name}: role 'train', but it has no labelled colour image")
        if not capture.label.any():
            note(f"capture {capture.name}: nothing in it is labelled, so nothing is learnt from it")
            continue
        if not gathered.names:
            gathered.exposure_s = capture.colour.exposure_s
        gathered.names.append(capture.name)
        with naming(capture):
            view, image = view_surface(capture.depth.depth_mm, rig), lit_image(capture, rig)
        ratio = exposure_ratio(gathered.exposure_s, capture.colour.exposure_s)
        for feature, samples in gathered.colour.items():
            with naming(capture):
                values, valid = colour_features(feature, image, view, rig, mode, ratio)
            for label in range(class_count):
                pixels = np.argwhere(valid & (capture.label == label + 1))
                if len(pixels) > settings.pixels_per_class:
                    pixels = pixels[rng.choice(len(pixels), settings.pixels_per_class, replace=False)]
                row, col = pixels.T
                samples.add(values[:, row, col].T, label, _place(row, col, number, settings.place_px))
        _gather_windows(gathered.texture, image, capture.label, number, rig, class_count, settings)
    if not gathered.names:
        raise InputError("there is no capture of role 'train' with a label to train from")
    return gathered


def _gather_windows(
    samples: _Samples,
    image: Image,
    label: NDArray[np.uint8],
    number: int,
    rig: Rig,
    class_count: int,
    settings: TrainingSettings,
) -> None:
    side, stride = settings.window_px, settings.window_px // 2
    features = texture_features(rig.features.texture, image, side, stride)
    grid = np.indices(features.shape[:2]) * stride + side // 2
    pure = _pure_windows(label, side, stride)
    for k in range(class_count):
        chosen = pure == k + 1
        row, col = grid[:, chosen]
        samples.add(features[chosen], k, _place(row, col, number, settings.place_px))


def _tabulate(classifier: svm.Svm, values: Float64) -> PosteriorTable:
    """Tabulates over the samples' range and a quarter more on each side; beyond, features are clipped."""
    low, high = values.min(axis=0), values.max(axis=0)
    margin = 0.25 * (high - low)
    return PosteriorTable.build(classifier.posterior_on_grid, low - margin, high + margin)


def _reflectance_mode(rig: Rig, settings: TrainingSettings, note: Note) -> ReflectanceMode | None:
    """How K_d is computed; None where the rig does without it."""
    if rig.light is None:
        if rig.features.colour == "K_d":
            raise MissingCalibrationError(
                f"rig {rig.name}: features.colour is K_d, which needs a [light]; there is none"
            )
        note("no controlled light: the K_d route is left out")
        return None
    lacking = reflectance.lacking_for_full_model(rig)
    if settings.reflectance == "full" and lacking:
        raise MissingCalibrationError(f"rig {rig.name}: the full model lacks {', '.join(lacking)}")
    if settings.reflectance is None and lacking:
        note(f"K_d by the printed polynomial: the full model lacks {', '.join(lacking)}")
    return settings.reflectance or ("thesis" if lacking else "full")


def fit_response(captures: Iterable[Capture], rig: Rig) -> Float64:
    """Returns the polynomial of Eq. 4.4 for each channel, 1 at the median distance of the captures.

    Returns:
        (3, 3): a2, a1, a0 (metres) in rows R, G, B.

    Raises:
        MissingCalibrationError: As `response_samples`.
    """
    distance, intensity = response_samples(captures, rig)
    reference_m = float(np.median(distance))
    fits = [reflectance.fit_distance_polynomial(distance, channel, reference_m) for channel in intensity.T]
    return np.array(fits, np.float64)


def response_samples(captures: Iterable[Capture], rig: Rig) -> tuple[Float64, Float64]:
    """Returns the light's distance and the intensity where it falls straight on, for each capture.

    The samples are medians over the pixels within 3° of normal incidence (§4.2.2 takes one pixel).

    Returns:
        (n,) m and (n, 3) fractions of full scale.

    Raises:
        MissingCalibrationError: If there are fewer than three usable captures.
    """
    distance, intensity = [], []
    for capture in captures:
        rig.check(capture)
        view = view_surface(capture.depth.depth_mm, rig)
        if view.light_cosine is None or view.light_distance_m is None:
            raise MissingCalibrationError(f"rig {rig.name}: there is no [light]")
        fraction = as_fraction(lit_image(capture, rig))
        exposed = reflectance.well_exposed(fraction)
        straight = view.has_normal & exposed & (view.light_cosine > np.cos(np.radians(3)))
        if straight.any():
            distance.append(np.median(view.light_distance_m[straight]))
            intensity.append(np.median(fraction[:, straight], axis=1))
    if len(distance) < 3:
        raise MissingCalibrationError(
            f"rig {rig.name}: response.a2_a1_a0 is missing and {len(distance)} captures of role 'response' "
            "show a surface lit straight on; K_d by the printed polynomial needs at least 3 of them"
        )
    return np.array(distance, np.float64), np.array(intensity, np.float64)


def _pure_windows(label: NDArray[np.uint8], side: int, stride: int) -> NDArray[np.uint8]:
    """The label of every window that has but one, 0 for the others."""
    windows = np.lib.stride_tricks.sliding_window_view(label, (side, side))[::stride, ::stride]
    low, high = windows.min(axis=(2, 3)), windows.max(axis=(2, 3))
    pure: NDArray[np.uint8] = np.where(low == high, low, np.uint8(0))
    return pure


def _fit(
    values: Float64,
    labels: NDArray[np.intp],
    places: NDArray[np.intp],
    kernel: Literal["rbf", "linear"],
    settings: TrainingSettings,
) -> Classifier:
    if settings.classifier == "naive_bayes":
        return naive_bayes.train(values, labels)
    return svm.train(
        values,
        labels,
        places,
        kernel=kernel,
        C=settings.C,
        gamma=settings.gamma,
        folds=settings.folds,
        seed=settings.seed,
    )


def _place(row: NDArray[Any], col: NDArray[Any], number: int, side: int) -> NDArray[np.intp]:
    """A number for each square of `side` pixels of each capture."""
    place: NDArray[np.intp] = ((number * 1000 + row // side) * 1000 + col // side).astype(np.intp)
    return place


def _every_class_has_samples(labels: NDArray[np.intp], classes: SurfaceClasses, what: str) -> None:
    lacking = [name for number, name in enumerate(classes.names) if not (labels == number).any()]
    if lacking:
        raise InputError(f"the training captures have no {what} of {', '.join(lacking)}")
