"""Validation of everything a person writes: all faults at once, each with its path and the nearest name."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from surfclass.errors import ConfigurationError

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
Vector3 = tuple[Number, Number, Number]


class Table(BaseModel):
    """A table of a TOML file: frozen, and refusing keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


T = TypeVar("T", bound=BaseModel)


def validate(table: type[T], data: Mapping[str, Any], source: str) -> T:
    """Returns `data` as a `table`, or raises one ConfigurationError that lists every fault.

    Args:
        table: The pydantic model to validate against.
        data: The parsed file.
        source: What to call the file in the message, usually its path.

    Raises:
        ConfigurationError: With one line for each fault: its path, what is allowed, and for an
            unknown key the nearest known one.
    """
    try:
        return table.model_validate(data)
    except ValidationError as error:
        lines = [_fault(table, fault) for fault in error.errors(include_url=False)]
        raise ConfigurationError("\n  ".join([f"{source}:", *lines])) from None


def load_toml(text: str | bytes, source: str) -> dict[str, Any]:
    """Returns what the TOML `text` says, with or without a byte order mark; a syntax error names its line.

    Raises:
        ConfigurationError: Where the text is not UTF-8 or not TOML.
    """
    try:
        decoded = text.decode() if isinstance(text, bytes) else text
        return tomllib.loads(decoded.removeprefix("\ufeff"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{source}: not a TOML file: {error}") from None


def parse_toml(table: type[T], text: str | bytes, source: str) -> T:
    """Returns the TOML `text` as a `table`.

    Raises:
        ConfigurationError: As `load_toml` and `validate`.
    """
    return validate(table, load_toml(text, source), source)


def _fault(table: type[BaseModel], fault: Any) -> str:
    path = ".".join(str(step) for step in fault["loc"])
    if fault["type"] == "extra_forbidden":
        known = _known_keys(table, fault["loc"][:-1])
        nearest = difflib.get_close_matches(str(fault["loc"][-1]), known, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        return f"{path}: unknown key{hint} (known here: {', '.join(sorted(known))})"
    if fault["type"] == "missing":
        return f"{path}: missing"
    message = fault["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if isinstance(fault["input"], Mapping):  # what is wrong is between its keys; all of it is no help
        return f"{path}: {message}" if path else message
    return f"{path}: {message}, got {fault['input']!r:.80}"


def _known_keys(table: type[BaseModel], path: tuple[Any, ...]) -> list[str]:
    """The keys that the table at `path` below `table` has; a step that is no table ends the walk."""
    for step in path:
        field = table.model_fields.get(str(step))
        if field is None:
            continue
        for candidate in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(candidate, type) and issubclass(candidate, BaseModel):
                table = candidate
    return [field.alias or name for name, field in table.model_fields.items()]
