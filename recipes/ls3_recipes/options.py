"""Settings as frozen dataclasses: made from signatures, built from nested mappings, errors that name the section."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar, get_type_hints

from omegaconf import MISSING

from ls3_recipes.typed import did_you_mean, typed

S = TypeVar("S")


def from_signatures(
    name: str,
    doc: str,
    *sources: Callable[..., Any],
    only: Collection[str] = (),
    without: Collection[str] = (),
    types: Mapping[str, Any] | None = None,
    check: Callable[..., object] | None = None,
) -> type:
    """A frozen dataclass whose fields are the arguments of functions, constructors or dataclasses.

    Every option is defined, documented and checked where it is used; a configuration takes names, types and defaults
    from there.

    Args:
        name: of the dataclass.
        doc: its docstring.
        sources: whose arguments become fields; no two may have one name.
        only: the arguments that are taken; all keyword-only ones that are no tensordict key when empty.
        without: the arguments that are not taken, and all others are, instead of ``only``.
        types: of fields that a configuration may also write otherwise than the sources take them.
        check: called with all fields when an instance is made; raises ``ValueError`` for values out of range.

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
    hints = _hints(sources) | dict(types or {})
    namespace = {} if check is None else {"__post_init__": lambda self: check(**vars(self))}
    annotated = [(key, hints.get(key, Any), value) for key, value in fields.items()]
    made = dataclasses.make_dataclass(name, annotated, frozen=True, namespace=namespace)
    made.__doc__ = doc
    return made


def _hints(sources: Iterable[Callable[..., Any]]) -> dict[str, Any]:
    """The annotations of callables' arguments, of dataclasses their fields'."""
    out: dict[str, Any] = {}
    for source in sources:
        constructor = isinstance(source, type) and not dataclasses.is_dataclass(source)
        out |= get_type_hints(source.__init__ if constructor else source)  # type: ignore[misc]
    return out


@cache
def sections(settings: Any) -> dict[str, type]:
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


def require_sections(settings: type, values: Mapping[str, Any], where: str = "") -> None:
    """Raise ``ValueError`` for a single value where settings have a section.

    Args:
        settings: a class of settings.
        values: by name.
        where: the section that they stand in.
    """
    prefix = f"{where}." if where else ""
    for key in sections(settings).keys() & values.keys():  # type: ignore[arg-type]
        if not isinstance(values[key], Mapping):
            shown = "null" if values[key] is None else repr(values[key])
            raise ValueError(f"{prefix}{key} is a section, got {shown}: set {prefix}{key}.KEY=VALUE.")


def build(settings: type[S], values: Mapping[str, Any], where: str = "") -> S:
    """A dataclass, and those within, from a nested mapping.

    Args:
        settings: the dataclass.
        values: lists become tuples; what is left out keeps its default.
        where: the section that ``values`` are, as errors name it.

    Raises:
        ValueError: for a name that the dataclass lacks, one that it needs, or (from its own checks) a bad value;
            always with the section before the name. Also for a value in place of a section.
        TypeError: for a value of another type than the field's.

    Example:
        >>> Flight = from_signatures("Flight", "How to fly.", lambda *, speed=3.0: None)
        >>> build(Flight, {"sped": 2.0}, "flight")
        Traceback (most recent call last):
        ...
        ValueError: flight has no setting sped: did you mean flight.speed? It has: speed.
    """
    nested, hints = sections(settings), get_type_hints(settings)  # type: ignore[arg-type]
    fields = dataclasses.fields(settings)  # type: ignore[arg-type]
    names = [field.name for field in fields]
    prefix = f"{where}." if where else ""
    for key in values:
        if key not in names:
            raise ValueError(unknown(key, names, where, [prefix + name for name in leaves(settings)]))
    require_sections(settings, values, where)
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key in nested:
            arguments[key] = build(nested[key], value, prefix + key)
        elif value != MISSING:
            arguments[key] = typed(value, hints[key], prefix + key)
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


def unknown(key: str, names: Iterable[str], where: str, known: Iterable[str]) -> str:
    """The error for a name that a section lacks.

    Args:
        key: the name.
        names: those that the section has.
        where: the section; empty for the whole.
        known: names with their sections, of which the nearest is proposed.
    """
    nearest = did_you_mean(f"{where}.{key}" if where else key, known)
    return f"{where or 'The run'} has no setting {key}{nearest or '.'} It has: {', '.join(names)}."


def leaves(settings: type) -> list[str]:
    """The names of all settings within a dataclass, with their sections.

    Example:
        >>> leaves(from_signatures("Flight", "How to fly.", lambda *, speed=3.0: None))
        ['speed']
    """
    nested = sections(settings)
    out = []
    for field in dataclasses.fields(settings):
        inner = [f"{field.name}.{name}" for name in leaves(nested[field.name])] if field.name in nested else []
        out += inner or [field.name]
    return out


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
