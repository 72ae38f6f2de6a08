"""Keywords to a job's specification, by the names that the protos give to fields and enum values.

Knows no field by name except `triangles` and `render`: options appear here when the protos get
them. Values are judged by the server, which names every fault at once.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from google.protobuf.descriptor import EnumDescriptor, FieldDescriptor

from lookalike.v1 import spec_pb2

_SIMPLIFY = spec_pb2.SimplifySpec.DESCRIPTOR.fields_by_name
_RENDER = spec_pb2.RenderSpec.DESCRIPTOR.fields_by_name
#: Every keyword, for messages and for help.
OPTIONS = sorted(({*_SIMPLIFY} - {"triangles", "render"}) | {*_RENDER})


def simplify_spec(triangles: int | Iterable[int], **options: Any) -> spec_pb2.SimplifySpec:
    """The specification of a simplification; what is not given, or None, takes its default.

    Enum values are written in lower case (`effort="fast"`), directions as three numbers
    (`custom_views=[(1, 0, 0)]`).
    """
    spec = spec_pb2.SimplifySpec()
    levels = triangles if isinstance(triangles, Iterable) else [triangles]
    _assign(spec, _SIMPLIFY["triangles"], levels)
    for name, value in options.items():
        if name not in OPTIONS:
            near = difflib.get_close_matches(name, OPTIONS, n=1)
            hint = f"did you mean `{near[0]}`?" if near else f"use {', '.join(OPTIONS)}"
            raise TypeError(f"`{name}` is no option: {hint}")
        if value is None:
            continue
        if name in _RENDER:
            _assign(spec.render, _RENDER[name], value)
        else:
            _assign(spec, _SIMPLIFY[name], value)
    return spec


def enum_value(kind: EnumDescriptor, word: str) -> int:
    """The number of an enum value from its name without the prefix, in any case."""
    prefix = kind.values[0].name.removesuffix("UNSPECIFIED")
    value = kind.values_by_name.get(prefix + str(word).upper())
    if value is None:
        words = ", ".join(v.name.removeprefix(prefix).lower() for v in kind.values[1:])
        raise ValueError(f"`{word}` is no {kind.name.lower()}: use {words}")
    return value.number


def _assign(message: Any, field: FieldDescriptor, value: Any) -> None:
    try:
        if field.enum_type is not None:
            setattr(message, field.name, enum_value(field.enum_type, value))
        elif field.message_type is not None:
            rows = getattr(message, field.name)
            for x, y, z in value:
                rows.add(x=x, y=y, z=z)
        elif field.is_repeated:
            getattr(message, field.name).extend(value)
        else:
            setattr(message, field.name, value)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{field.name}: {error}") from error
