"""The model card: what a model was made of, how good it is on places that it has not seen, where it holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from surfclass.classifiers.reliability import Reliability, reliability
from surfclass.evaluation import score
from surfclass.rig import SurfaceClasses
from surfclass.sampling import Samples
from surfclass.training import HeldOut
from surfclass.types import Float64

_RESAMPLES = 400
_INTERVAL = (2.5, 97.5)  # percentiles: 95 % confidence
_ENDS = (2.0, 98.0)  # percentiles: from where to where the samples were seen


@dataclass(frozen=True, slots=True, eq=False)
class RouteCard:
    """How good one route is on places that it was not trained on.

    Attributes:
        told: As the card has it.
        reliability: For the picture.
    """

    told: dict[str, Any]
    reliability: Reliability

    @property
    def balanced(self) -> float:
        """Mean over the classes of the share that is right."""
        return float(self.told["balanced"])

    @property
    def ece(self) -> float:
        """Expected calibration error."""
        return float(self.told["ece"])


def assess(held_out: HeldOut, classes: SurfaceClasses, seed: int) -> RouteCard:
    """Returns the figures of one route's held-out posteriors.

    Accuracies have a 95 % interval from the bootstrap over places: samples of one place are nearly one
    sample, and an interval by their number would be many times too narrow.

    Args:
        held_out: What the route said of its training samples without having seen their places.
        classes: The surface types.
        seed: Of the bootstrap.
    """
    samples, posterior = held_out.samples, held_out.posterior
    found = score(samples.label, posterior, np.ones(len(posterior), bool))
    right = posterior.argmax(axis=1) == samples.label
    diagram = reliability(posterior.max(axis=1), right)
    random = np.random.default_rng(seed)
    told: dict[str, Any] = {
        "samples": len(right),
        "places": len(np.unique(samples.place)),
        "held_out_by": "place" if held_out.by == "groups" else "sample",
        "C": held_out.C,
        "gamma": held_out.gamma,
        "trials": [asdict(trial) for trial in held_out.trials],
        "accuracy": found.overall,
        "balanced": found.balanced,
        "interval_95": _interval(right.astype(np.float64), samples, None, random),
        "per_class": {
            name: {
                "accuracy": float(right[samples.label == k].mean()),
                "interval_95": _interval(right.astype(np.float64), samples, k, random),
                "samples": int((samples.label == k).sum()),
                "places": len(np.unique(samples.place[samples.label == k])),
            }
            for k, name in enumerate(classes.names)
        },
        "confusion": found.confusion.tolist(),
        "ece": found.ece,
        "nll": found.nll,
        "reliability": diagram.to_json(),
        **_seen(samples),
    }
    return RouteCard(told, diagram)


def _interval(
    right: Float64, samples: Samples, k: int | None, random: np.random.Generator
) -> list[float] | None:
    """95 % of the bootstrap over places; None where there is a single place."""
    chosen = np.flatnonzero(samples.label == k) if k is not None else np.arange(len(right))
    place = np.unique(samples.place[chosen], return_inverse=True)[1].reshape(-1)
    total = np.bincount(place)
    if len(total) < 2:
        return None
    hits = np.bincount(place, right[chosen])
    times = random.multinomial(len(total), np.full(len(total), 1 / len(total)), size=_RESAMPLES)
    low, high = np.percentile(times @ hits / np.maximum(times @ total, 1), _INTERVAL)
    return [float(low), float(high)]


def _seen(samples: Samples) -> dict[str, Any]:
    """From where the samples were seen; None where it was not measured."""

    def ends(values: Float64) -> list[float] | None:
        known = values[np.isfinite(values)]
        return [float(end) for end in np.percentile(known, _ENDS)] if len(known) else None

    return {"distance_m": ends(samples.distance_m), "angle_rad": ends(samples.angle_rad)}


def limits_of_use(
    cards: dict[str, RouteCard], reflectance: str | None, classifier: str, exposure_s: float | None
) -> list[str]:
    """Returns sentences on where the figures hold, and where not.

    Args:
        cards: By route.
        reflectance: How K_d is computed; None: not at all.
        classifier: "svm" or "naive_bayes".
        exposure_s: Of the training captures.
    """
    said = []
    seen = [card.told for card in cards.values() if card.told["distance_m"] and card.told["angle_rad"]]
    if seen:
        near, far = (end([told["distance_m"][i] for told in seen]) for i, end in ((0, min), (1, max)))
        direct, oblique = (end([told["angle_rad"][i] for told in seen]) for i, end in ((0, min), (1, max)))
        said.append(
            f"trained from {near:.2f} to {far:.2f} m and {np.degrees(direct):.0f} to "
            f"{np.degrees(oblique):.0f}°: the figures hold there; what holds elsewhere `evaluate` says, on "
            "labelled `test` captures"
        )
    said += [
        f"{route}: a class has one place only, so samples of the same place were held out: accuracy and "
        "confidence are too good"
        for route, card in cards.items()
        if card.told["held_out_by"] == "sample"
    ]
    if classifier == "svm":
        said.append("a surface that was never trained on is named as the class that it resembles most")
    if reflectance == "thesis":
        at = "one exposure" if exposure_s is None else f"an exposure of {1e3 * exposure_s:g} ms"
        said.append(f"K_d is by the printed polynomial: it holds at {at}, and near the normal")
    return said
