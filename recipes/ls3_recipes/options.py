"""Settings as frozen dataclasses: made from signatures, built from nested mappings, errors that name the section."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar, get_type_hints

from omegaconf import MISSING

S = TypeVar("S")


def from_signatures(
    name: str, doc: str, *sources: Callable[..., Any], only: Collection[str] = (), without: Collection[str] = ()
) -> type:
    """A frozen dataclass whose fields are the arguments of functions, constructors or dataclasses.

    Every option is defined, documented and checked where it is used; a configuration takes names and defaults from
    there.

    Args:
        name: of the dataclass.
        doc: its docstring.
        sources: whose arguments become fields; no two may have one name.
        only: the arguments that are taken; all keyword-only ones that are no tensordict key when empty.
        without: the arguments that are not taken, and all others are, instead of ``only``.

    Raises:
        ValueError: when two sources share a name, or one in ``only`` or ``without`` is no argument.

    Example:
        >>> def fly(height, *, speed=3.0, height_key="z"): ...
        >>> from_signatures("Flight", "How to fly.", fly)()
        Flight(speed=3.0)
        >>> from_signatures("Flight", "How high.", fly, only=("height",))(height=2)
        Flight(height=2)
    """
    fields: dict[str, Any] = {}
    named: set[str] = set()
    for source in sources:
        for argument in inspect.signature(source).parameters.values():
            keyword = argument.kind is inspect.Parameter.KEYWORD_ONLY and not argument.name.endswith(("_key", "_keys"))
            named.add(argument.name)
            if argument.name not in without if without else argument.name in only if only else keyword:
                if argument.name in fields:
                    raise ValueError(f"{name}: two of {sources} have an argument {argument.name}. Rename one.")
                default = argument.default
                fields[argument.name] = dataclasses.field(
                    **({} if default is inspect.Parameter.empty else {"default": default}), kw_only=True
                )
    if missing := {*only, *without} - named:
        raise ValueError(f"{name}: none of {sources} has an argument {', '.join(sorted(missing))}.")
    made = dataclasses.make_dataclass(name, [(key, Any, value) for key, value in fields.items()], frozen=True)
    made.__doc__ = doc
    return made


def sections(settings: type) -> dict[str, type]:
    """The fields of a dataclass that are dataclasses themselves, by name."""
    hints = get_type_hints(settings)
    names = [field.name for field in dataclasses.fields(settings)]
    return {name: hints[name] for name in names if dataclasses.is_dataclass(hints[name])}


def defaults(settings: type) -> dict[str, Any]:
    """The fields of a dataclass, and of those within, with their defaults; OmegaConf's ``???`` where there is none.

    Example:
        >>> defaults(from_signatures("Flight", "How to fly.", lambda height, *, speed=3.0: None))
        {'speed': 3.0}
    """
    nested, out = sections(settings), {}
    for field in dataclasses.fields(settings):
        if field.name in nested:
            out[field.name] = defaults(nested[field.name])
        elif field.default is not dataclasses.MISSING:
            out[field.name] = _plain(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            out[field.name] = _plain(field.default_factory())
        else:
            out[field.name] = MISSING
    return out


def build(settings: type[S], values: Mapping[str, Any], where: str = "") -> S:
    """A dataclass, and those within, from a nested mapping.

    Args:
        settings: the dataclass.
        values: lists become tuples; what is left out keeps its default.
        where: the section that ``values`` are, as errors name it.

    Raises:
        ValueError: for a name that the dataclass lacks, one that it needs, or (from its own checks) a bad value;
            always with the section before the name. Also for a value in place of a section.

    Example:
        >>> Flight = from_signatures("Flight", "How to fly.", lambda *, speed=3.0: None)
        >>> build(Flight, {"sped": 2.0}, "flight")
        Traceback (most recent call last):
        ...
        ValueError: flight has no setting sped. It has: speed.
    """
    nested = sections(settings)
    fields = dataclasses.fields(settings)  # type: ignore[arg-type]
    names = [field.name for field in fields]
    for key in values:
        if key not in names:
            raise ValueError(f"{where or 'The run'} has no setting {key}. It has: {', '.join(names)}.")
    prefix = f"{where}." if where else ""
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key in nested:
            if value is not None and not isinstance(value, Mapping):
                raise ValueError(f"{prefix}{key} is a section, got {value!r}: set {prefix}{key}.KEY=VALUE.")
            arguments[key] = build(nested[key], value or {}, prefix + key)
        elif value != MISSING:
            arguments[key] = _tuples(value)
    required = {
        field.name
        for field in fields
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }
    for key in sorted(required & nested.keys() - arguments.keys()):
        arguments[key] = build(nested[key], {}, prefix + key)
    if missing := sorted(required - arguments.keys()):
        raise ValueError(f"{prefix}{missing[0]} must be given: it has no default.")
    with errors_of(where, names):
        return settings(**arguments)


def as_dict(settings: Any) -> dict[str, Any]:
    """A dataclass of settings as nested dictionaries and lists, as YAML has them."""
    return {
        field.name: as_dict(value) if dataclasses.is_dataclass(value) else _plain(value)
        for field in dataclasses.fields(settings)
        for value in [getattr(settings, field.name)]
    }


@contextmanager
def errors_of(section: str, names: Collection[str]) -> Iterator[None]:
    """Name the section in a ``ValueError`` that begins with one of its settings.

    Example:
        >>> with errors_of("vae", ["steps"]):
        ...     raise ValueError("steps must be at least 1, got 0.")
        Traceback (most recent call last):
        ...
        ValueError: vae.steps must be at least 1, got 0.
    """
    try:
        yield
    except ValueError as error:
        message = str(error)
        if section and message.split(" ", 1)[0].split(".", 1)[0].rstrip(":,") in names:
            raise ValueError(f"{section}.{message}") from error
        raise


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, tuple | list) else value
