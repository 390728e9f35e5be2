"""What training makes and frames are classified with: the routes, their classes and a model card."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from surfclass.classifiers.naive_bayes import NaiveBayes
from surfclass.classifiers.svm import Svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import ColourFeature, Response, Rig, SurfaceClasses
from surfclass.routes import Classifier, ColourRoute, TextureRoute
from surfclass.types import Float64

SCHEMA = 1
_KINDS: dict[str, type[Svm] | type[NaiveBayes]] = {"svm": Svm, "naive_bayes": NaiveBayes}


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Trained classifiers of both routes.

    Attributes:
        classes: The surface types, in the order of every distribution.
        colour: One route for each colour feature that could be trained.
        texture: The texture route.
        a2_a1_a0: (3, 3) the polynomial of Eq. 4.4 that training fitted, where the rig had none.
        card: Provenance and figures, JSON.
    """

    classes: SurfaceClasses
    colour: dict[ColourFeature, ColourRoute]
    texture: TextureRoute
    a2_a1_a0: Float64 | None = None
    card: dict[str, Any] = field(default_factory=dict)

    def complete(self, rig: Rig) -> Rig:
        """Returns the rig with the polynomial that training fitted, where the rig has none."""
        if self.a2_a1_a0 is None or (rig.response is not None and rig.response.a2_a1_a0 is not None):
            return rig
        return with_polynomial(rig, self.a2_a1_a0)

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
        if self.a2_a1_a0 is not None:
            arrays["a2_a1_a0"] = self.a2_a1_a0
        head = {
            "schema": SCHEMA,
            "classes": self.classes.model_dump(mode="json"),
            "routes": routes,
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
        return cls(classes, colour, texture, arrays.get("a2_a1_a0"), head["card"])


def with_polynomial(rig: Rig, rows: Float64) -> Rig:
    """Returns the rig with the polynomial of Eq. 4.4 set to `rows` (3, 3)."""
    inverse = None if rig.response is None else rig.response.inverse
    response = Response.model_validate({"a2_a1_a0": rows.tolist(), "inverse": inverse})
    return rig.model_copy(update={"response": response})


def _kind(classifier: Classifier) -> str:
    return next(name for name, kind in _KINDS.items() if isinstance(classifier, kind))


def _prefixed(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {prefix + name: array for name, array in arrays.items()}


def _below(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
