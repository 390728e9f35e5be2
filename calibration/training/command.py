"""`surfclass train`: labelled captures become a model, judged on places that it was not trained on."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from calibration.gates import TrainGates
from calibration.light.photometry import photometry_from
from calibration.outcome import SCHEMA, Figures, Note, Outcome, RefusedError, plain
from calibration.source import Source
from calibration.training.card import RouteCard, assess, limits_of_use
from calibration.training.pictures import draw_confusions, draw_features, draw_reliability
from surfclass import reflectance
from surfclass.errors import InputError
from surfclass.fingerprint import fingerprints
from surfclass.model import Model
from surfclass.training import Trained, TrainingSettings, train_checked


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A model and what there is to say of it.

    Attributes:
        model: With its card.
        outcome: Of kind "train"; `result` is the card.
    """

    model: Model
    outcome: Outcome


def train_model(source: Source, settings: TrainingSettings, gates: TrainGates, note: Note) -> Result:
    """Trains from the `train` captures of a source.

    What the full reflectance model needs and the rig lacks is found from the source's `exposure`, `light`
    and `response` captures, if they determine it, and travels in the model.

    Args:
        source: Captures, classes and rig.
        settings: How to train; with `reflectance` "thesis" nothing but the printed polynomial is found.
        gates: The limits.
        note: Called with a sentence at each step.

    Raises:
        InputError: If the source cannot be used.
        MissingCalibrationError: If the rig lacks what its colour feature needs.
    """
    if source.classes is None:
        raise InputError(f"{source.path}: has no classes.toml, so its labels mean nothing")
    trained = train_checked(
        source.captures("train"),
        source.captures("response"),
        source.rig.whole(),
        source.classes,
        settings,
        note,
        _photometry(source, settings, note),
    )
    cards = {
        route: assess(held_out, source.classes, settings.seed) for route, held_out in trained.held_out.items()
    }
    main, texture = source.rig.features.colour, trained.model.texture.feature
    reasons = _reasons(cards, main, texture, gates)
    verdict = "fail" if reasons else "pass"
    card = _card(source, trained, cards) | {"verdict": verdict, "reasons": list(reasons)}
    model = replace(trained.model, card=plain(card))
    routes = {"reliability": partial(draw_reliability, cards)}
    outcome = Outcome(
        kind="train",
        verdict="fail" if reasons else "pass",
        reasons=reasons,
        sentence=_sentence(cards, main, texture, trained.model.card["reflectance"]),
        result={"schema": SCHEMA, "verdict": verdict, "reasons": list(reasons), **model.card},
        figures=_figures(cards, source.classes.names, card["limits_of_use"]),
        pictures={
            **routes,
            "confusion": partial(draw_confusions, cards, source.classes),
            "features": partial(draw_features, main, trained.held_out[main], source.classes),
        },
    )
    return Result(model, outcome)


def _photometry(source: Source, settings: TrainingSettings, note: Note) -> dict[str, Any]:
    """What the full model needs and the rig lacks, where the captures can tell; else nothing, and why."""
    rig = source.rig.whole()
    told = any(source.count(role) for role in ("exposure", "light", "response"))
    known = rig.light is not None and not reflectance.lacking_for_full_model(rig)
    if settings.reflectance == "thesis" or known or not told:
        return {}
    try:
        return photometry_from(source, note)
    except RefusedError as error:
        for reason in error.reasons:
            note(f"the full reflectance model cannot be found from these captures: {reason}")
        return {}


def _card(source: Source, trained: Trained, cards: dict[str, RouteCard]) -> dict[str, Any]:
    own = trained.model.card
    return {
        **own,
        "version": importlib.metadata.version("surfclass"),
        "source": source.path.name,
        "sha256": source.digests(),
        "made_with": fingerprints(trained.model.complete(source.rig.whole())),
        "rig_values": trained.model.rig_values,
        "routes": {route: card.told for route, card in cards.items()},
        "limits_of_use": limits_of_use(
            cards, own["reflectance"], own["settings"]["classifier"], own["exposure_s"]
        ),
    }


def _reasons(cards: dict[str, RouteCard], main: str, texture: str, gates: TrainGates) -> tuple[str, ...]:
    reasons = []
    for route, least in ((main, gates.colour_accuracy), (texture, gates.texture_accuracy)):
        if cards[route].balanced < least:
            reasons.append(
                f"{route}: {cards[route].balanced:.1%} of held-out samples are right, "
                f"allowed is at least {least:.1%}: look at the confusion, label more places"
            )
        if cards[route].ece > gates.ece:
            reasons.append(
                f"{route}: expected calibration error {cards[route].ece:.3f}, allowed is {gates.ece:g}: the "
                "places differ more than a few of them can tell; label more places"
            )
    return tuple(reasons)


def _sentence(cards: dict[str, RouteCard], main: str, texture: str, mode: str | None) -> str:
    how = {"full": ", full reflectance model", "thesis": ", printed polynomial", None: ""}[mode]
    return "; ".join(
        f"{route} {cards[route].balanced:.1%} right on held-out places (calibration error "
        f"{cards[route].ece:.3f}){how if route == 'K_d' else ''}"
        for route in (main, texture)
    )


def _figures(cards: dict[str, RouteCard], names: tuple[str, ...], limits: list[str]) -> tuple[Figures, ...]:
    columns = ("surface", *(f"{route}, %" for route in cards))
    rows = [(name, *(_share(card.told["per_class"][name]) for card in cards.values())) for name in names]
    rows += [("all, balanced", *(f"{100 * card.balanced:.1f}" for card in cards.values()))]
    rows += [("calibration error", *(f"{card.ece:.3f}" for card in cards.values()))]
    rows += [("NLL, nats", *(f"{card.told['nll']:.3f}" for card in cards.values()))]
    rows += [("places", *(str(card.told["places"]) for card in cards.values()))]
    return (
        Figures("right on held-out places (95 % interval over places)", columns, rows),
        Figures("limits of use", ("of this model",), [(sentence,) for sentence in limits]),
    )


def _share(told: dict[str, Any]) -> str:
    interval = told["interval_95"]
    within = "" if interval is None else f" ({100 * interval[0]:.0f}–{100 * interval[1]:.0f})"
    return f"{100 * told['accuracy']:.1f}{within}"
