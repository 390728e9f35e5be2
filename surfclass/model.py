"""What training makes and frames are classified with: the routes, their classes and a model card."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from surfclass.classifiers.naive_bayes import NaiveBayes
from surfclass.classifiers.svm import Svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import ColourFeature, Rig, SurfaceClasses
from surfclass.routes import Classifier, ColourRoute, TextureRoute

SCHEMA = 2
_FITTED_TOGETHER = ("light",)
_KINDS: dict[str, type[Svm] | type[NaiveBayes]] = {"svm": Svm, "naive_bayes": NaiveBayes}


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Trained classifiers of both routes.

    Attributes:
        classes: The surface types, in the order of every distribution.
        colour: One route for each colour feature that could be trained.
        texture: The texture route.
        rig_values: What training found of the rig where the rig said nothing, nested as in `rig.toml`:
            response, vignetting and the light's fall-off, or the polynomial of Eq. 4.4.
        card: Provenance and figures, JSON.
    """

    classes: SurfaceClasses
    colour: dict[ColourFeature, ColourRoute]
    texture: TextureRoute
    rig_values: Mapping[str, Any] = field(default_factory=dict)
    card: dict[str, Any] = field(default_factory=dict)

    def complete(self, rig: Rig) -> Rig:
        """Returns the rig with what training found, where the rig says nothing (`completed`)."""
        return completed(rig, self.rig_values)

    def colour_route(self, feature: ColourFeature) -> ColourRoute:
        """Returns the route of one colour feature.

        Raises:
            ConfigurationError: If the model was not trained on it.
        """
        if feature not in self.colour:
            raise ConfigurationError(
                f"the model has no colour route for {feature}; it was trained on: {', '.join(self.colour)}"
            )
        return self.colour[feature]

    def check(self, rig: Rig, classes: SurfaceClasses | None = None) -> None:
        """Raises ConfigurationError where the model does not fit the rig's features or the classes."""
        self.colour_route(rig.features.colour)
        if self.texture.feature != rig.features.texture:
            raise ConfigurationError(
                f"the model's texture route was trained on {self.texture.feature}, "
                f"rig {rig.name} says {rig.features.texture}"
            )
        if classes is not None and classes.names != self.classes.names:
            raise ConfigurationError(
                f"the model knows the classes {', '.join(self.classes.names)}, "
                f"the captures have {', '.join(classes.names)}"
            )

    def to_bytes(self) -> bytes:
        """Returns the model as an .npz without pickle; equal models give equal bytes."""
        routes: dict[str, Any] = {}
        arrays: dict[str, NDArray[Any]] = {}
        for position, (feature, route) in enumerate(self.colour.items()):
            prefix = f"colour{position}"
            routes[prefix] = {
                "feature": feature,
                "reflectance": route.reflectance,
                "exposure_s": route.exposure_s,
                "classifier": _kind(route.classifier),
                "table": route.table is not None,
            }
            arrays |= _prefixed(f"{prefix}.classifier.", route.classifier.to_arrays())
            if route.table is not None:
                arrays |= _prefixed(f"{prefix}.table.", route.table.to_arrays())
        routes["texture"] = {
            "feature": self.texture.feature,
            "window_px": self.texture.window_px,
            "classifier": _kind(self.texture.classifier),
        }
        arrays |= _prefixed("texture.classifier.", self.texture.classifier.to_arrays())
        head = {
            "schema": SCHEMA,
            "classes": self.classes.model_dump(mode="json"),
            "routes": routes,
            "rig_values": self.rig_values,
            "card": self.card,
        }
        arrays["head"] = np.frombuffer(json.dumps(head, sort_keys=True).encode(), np.uint8)
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, **{name: arrays[name] for name in sorted(arrays)})
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, source: str) -> Model:
        """Returns the model in an .npz made by `to_bytes`.

        Raises:
            ConfigurationError: If it is not one, or of an unknown schema; `source` names it.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            head = json.loads(arrays["head"].tobytes())
            if head["schema"] != SCHEMA:
                raise ConfigurationError(f"{source}: model schema {head['schema']}, allowed is {SCHEMA}")
            return cls._from_parts(head, arrays)
        except (ValueError, KeyError, TypeError, EOFError, OSError, zipfile.BadZipFile) as error:
            if isinstance(error, ConfigurationError):
                raise
            raise ConfigurationError(f"{source}: not a surfclass model ({error})") from None

    @classmethod
    def _from_parts(cls, head: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Model:
        colour: dict[ColourFeature, ColourRoute] = {}
        routes = head["routes"]
        for prefix in sorted(name for name in routes if name.startswith("colour")):
            told = routes[prefix]
            if told["feature"] not in get_args(ColourFeature):
                raise InputError(f"unknown colour feature {told['feature']!r}")
            table = None
            if told["table"]:
                table = PosteriorTable.from_arrays(_below(f"{prefix}.table.", arrays))
            colour[told["feature"]] = ColourRoute(
                feature=told["feature"],
                reflectance=told["reflectance"],
                exposure_s=told["exposure_s"],
                classifier=_KINDS[told["classifier"]].from_arrays(_below(f"{prefix}.classifier.", arrays)),
                table=table,
            )
        told = routes["texture"]
        texture = TextureRoute(
            feature=told["feature"],
            window_px=told["window_px"],
            classifier=_KINDS[told["classifier"]].from_arrays(_below("texture.classifier.", arrays)),
        )
        classes = SurfaceClasses.model_validate(head["classes"])
        told = head["rig_values"]
        if not isinstance(told, dict) or set(told) - set(Rig.model_fields):
            raise InputError(f"rig values {told!r:.80}, allowed are tables of rig.toml")
        return cls(classes, colour, texture, told, head["card"])


def completed(rig: Rig, values: Mapping[str, Any]) -> Rig:
    """Returns the rig with those of `values` that it does not have itself.

    A light is one thing: where its direction or its fall-off is filled in, so is the position that they
    were fitted with.

    Args:
        rig: What it says stays.
        values: Nested as in `rig.toml`.

    Raises:
        ConfigurationError: If a value is not what `rig.toml` allows.
    """
    lacking = _lacking(rig.model_dump(by_alias=True, exclude_unset=True), values)
    return rig.with_values(lacking).whole() if lacking else rig


def _lacking(told: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """What of `values` is not in `told`, table by table."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        have = told.get(key)
        if have is None:
            found[key] = value
        elif isinstance(have, Mapping) and isinstance(value, Mapping):
            below = _lacking(have, value)
            if below:
                found[key] = value if key in _FITTED_TOGETHER else below
    return found


def _kind(classifier: Classifier) -> str:
    return next(name for name, kind in _KINDS.items() if isinstance(classifier, kind))


def _prefixed(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {prefix + name: array for name, array in arrays.items()}


def _below(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
