"""Training: labelled captures become a Model; samples are held out by place, never by pixel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from surfclass import reflectance
from surfclass.classifiers import naive_bayes, svm
from surfclass.classifiers.folds import deal_folds
from surfclass.classifiers.search import Trial, search
from surfclass.classifiers.selection import Selection
from surfclass.classifiers.table import PosteriorTable
from surfclass.colour import as_fraction
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import Capture
from surfclass.model import Model, completed
from surfclass.pipeline import lit_image
from surfclass.rig import ColourFeature, Rig, SurfaceClasses
from surfclass.routes import Classifier, ColourRoute, ReflectanceMode, TextureRoute
from surfclass.sampling import Note, Samples, Sampling
from surfclass.types import Float64
from surfclass.viewing import view_surface

_POOL = 4  # samples of a class and capture among which the drawing can choose, over those it takes


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How a model is trained.

    Attributes:
        classifier: "svm" (RBF for colour, linear for texture), or "naive_bayes".
        reflectance: How K_d is computed; None takes the full model where the rig has what it
            needs, else the printed polynomial.
        pixels_per_class: Colour samples of each class.
        windows_per_class: Texture samples of each class.
        window_px: Side of a texture window.
        place_px: Side of the square of pixels that is one place for hold-out.
        selection: How samples are drawn: "even" over places and intensities, or "random".
        C: SVM's penalty; None: by cross-validation out of `search_C` or `search_texture_C`.
        gamma: RBF's width, for standardised features; None: by cross-validation out of `search_gamma`.
        search_C: What is tried for colour; wilder machines are no better on other places, and much worse
            at other distances.
        search_gamma: Likewise.
        search_texture_C: What is tried for texture: its many features overlap less, and large penalties
            take the linear machine minutes without being better.
        search_per_class: Samples of each class that are tried with.
        search_folds: Of the hold-out by which the two are chosen.
        folds: Of the hold-out that the posteriors are fitted on.
        seed: Of the drawing and the folds.
    """

    classifier: Literal["svm", "naive_bayes"] = "svm"
    reflectance: ReflectanceMode | None = None
    pixels_per_class: int = 1500
    windows_per_class: int = 1000
    window_px: int = 20
    place_px: int = 80
    selection: Selection = "even"
    C: float | None = None
    gamma: float | None = None
    search_C: tuple[float, ...] = (1.0, 10.0)
    search_texture_C: tuple[float, ...] = (0.01, 0.1, 1.0)
    search_gamma: tuple[float, ...] = (0.1, 0.3, 1.0)
    search_per_class: int = 400
    search_folds: int = 3
    folds: int = 5
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """What a route said of its training samples without having seen the places that they are from.

    Attributes:
        samples: Labels, places, captures, distances and angles.
        posterior: (n, k) class distributions.
        by: "groups" where no sample's place was trained on; "samples" where a class had one place only.
        C: SVM's penalty; None for another classifier.
        gamma: RBF's width, likewise.
        trials: What was tried to choose them.
    """

    samples: Samples
    posterior: Float64
    by: Literal["groups", "samples"]
    C: float | None
    gamma: float | None
    trials: tuple[Trial, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A model and what is known of it.

    Attributes:
        model: The model.
        held_out: By route: "RGB", "a*b*", "K_d" and the texture feature.
        captures: Names of the captures that it was trained on, by their number in `held_out`.
    """

    model: Model
    held_out: dict[str, HeldOut]
    captures: list[str]


def train(
    captures: Iterable[Capture],
    response_captures: Iterable[Capture],
    rig: Rig,
    classes: SurfaceClasses,
    settings: TrainingSettings | None = None,
    note: Note = lambda _: None,
) -> Model:
    """Returns the model of `train_checked`, whose arguments these are.

    Raises:
        InputError, MissingCalibrationError: As `train_checked`.
    """
    return train_checked(captures, response_captures, rig, classes, settings, note).model


def train_checked(
    captures: Iterable[Capture],
    response_captures: Iterable[Capture],
    rig: Rig,
    classes: SurfaceClasses,
    settings: TrainingSettings | None = None,
    note: Note = lambda _: None,
    rig_values: Mapping[str, Any] | None = None,
) -> Trained:
    """Returns a model with a colour route for every feature that the rig allows, and a texture route.

    Args:
        captures: Labelled captures of role "train"; one at a time is held in memory.
        response_captures: Captures of role "response"; used only where K_d is wanted in thesis
            mode and the rig has no polynomial.
        rig: The sensor package.
        classes: What the labels mean.
        settings: See TrainingSettings.
        note: Called with a sentence at each step.
        rig_values: What else is known of the rig; it completes the rig, and the model keeps it.

    Raises:
        InputError: If there is no labelled capture, or a class has no sample.
        MissingCalibrationError: If K_d is the rig's colour feature and cannot be computed.
    """
    settings = settings or TrainingSettings()
    values = dict(rig_values or {})
    rig = completed(rig, values)
    mode = _reflectance_mode(rig, settings, note)
    if mode == "thesis" and (rig.response is None or rig.response.a2_a1_a0 is None):
        try:
            polynomial = fit_response(response_captures, rig)
        except MissingCalibrationError as error:
            if rig.features.colour == "K_d":
                raise
            note(f"the K_d route is left out: {error}")
            mode = None
        else:
            note("fitted the polynomial of Eq. 4.4 to the response captures")
            values["response"] = {**values.get("response", {}), "a2_a1_a0": polynomial.tolist()}
            rig = completed(rig, values)
    features: list[ColourFeature] = ["RGB", "a*b*"] if mode is None else ["RGB", "a*b*", "K_d"]

    sampling = Sampling(
        features, mode or "thesis", len(classes.names), _POOL * settings.pixels_per_class,
        settings.window_px, settings.place_px, settings.seed,
    )  # fmt: skip
    gathered = sampling.gather(captures, rig, note)
    colour: dict[ColourFeature, ColourRoute] = {}
    held_out: dict[str, HeldOut] = {}
    for feature in features:
        note(f"training the {feature} route")
        drawn = gathered.colour[feature].drawn(settings.pixels_per_class, settings.selection, settings.seed)
        _every_class_has_samples(drawn, classes, f"{feature} pixel (K_d needs a normal and a good exposure)")
        classifier, held_out[feature] = _fit(drawn, "rbf", settings)
        table = _tabulate(classifier, drawn.values) if isinstance(classifier, svm.Svm) else None
        colour[feature] = ColourRoute(feature, mode or "thesis", gathered.exposure_s, classifier, table)
    note(f"training the {rig.features.texture} route")
    drawn = gathered.texture.drawn(settings.windows_per_class, settings.selection, settings.seed)
    side = settings.window_px
    _every_class_has_samples(drawn, classes, f"window of {side} × {side} px that is all of one label")
    classifier, held_out[rig.features.texture] = _fit(drawn, "linear", settings)
    texture = TextureRoute(rig.features.texture, settings.window_px, classifier)
    card = {
        "settings": asdict(settings),
        "rig": rig.name,
        "captures": gathered.names,
        "reflectance": mode,
        "exposure_s": gathered.exposure_s,
    }
    return Trained(Model(classes, colour, texture, values, card), held_out, gathered.names)


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


def _fit(drawn: Samples, kernel: svm.Kernel, settings: TrainingSettings) -> tuple[Classifier, HeldOut]:
    """Fits the classifier, and says what it makes of each sample without having seen its place."""
    if settings.classifier == "naive_bayes":
        return _fit_naive_bayes(drawn, settings)
    C, gamma, trials = settings.C, settings.gamma, tuple[Trial, ...]()
    if C is None or gamma is None:
        few = drawn.drawn(settings.search_per_class, settings.selection, settings.seed)
        chosen, tried = search(
            few.values,
            few.label,
            few.place,
            kernel,
            (settings.search_C if kernel == "rbf" else settings.search_texture_C) if C is None else (C,),
            settings.search_gamma if gamma is None else (gamma,),
            settings.search_folds,
            settings.seed,
        )
        C, gamma, trials = chosen.C, chosen.gamma, tuple(tried)
    found = svm.cross_fit(
        drawn.values,
        drawn.label,
        drawn.place,
        kernel=kernel,
        C=C,
        gamma=gamma,
        folds=settings.folds,
        seed=settings.seed,
    )
    machine = found.machine
    of_kernel = gamma if kernel == "rbf" else None
    return machine, HeldOut(drawn.at(found.rows), found.posterior, machine.held_out, C, of_kernel, trials)


def _fit_naive_bayes(drawn: Samples, settings: TrainingSettings) -> tuple[Classifier, HeldOut]:
    fold, by = deal_folds(drawn.label, drawn.place, settings.folds, settings.seed)
    posterior = np.empty((len(drawn.label), int(drawn.label.max()) + 1))
    for part in np.unique(fold):
        others = drawn.at(np.flatnonzero(fold != part))
        without = naive_bayes.train(others.values, others.label)
        posterior[fold == part] = without.posterior(drawn.values[fold == part])
    classifier = naive_bayes.train(drawn.values, drawn.label)
    return classifier, HeldOut(drawn, posterior, by, None, None, ())


def _every_class_has_samples(drawn: Samples, classes: SurfaceClasses, what: str) -> None:
    lacking = [name for number, name in enumerate(classes.names) if not (drawn.label == number).any()]
    if lacking:
        raise InputError(f"the training captures have no {what} of {', '.join(lacking)}")
