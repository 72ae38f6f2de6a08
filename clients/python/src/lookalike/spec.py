"""Keywords to a job's specification, by the names that the protos give to fields and enum values.

Knows no field by name except those that hold others: options appear here when the protos get them.
Values are judged by the server, which names every fault at once.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, TypeVar

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor

from lookalike.v1 import spec_pb2

#: Any kind of job.
Work = spec_pb2.SimplifySpec | spec_pb2.OptimizeSpec | spec_pb2.EvaluateSpec
_W = TypeVar("_W", spec_pb2.SimplifySpec, spec_pb2.OptimizeSpec, spec_pb2.EvaluateSpec)

#: Fields that hold fields of their own, and what those are prefixed with as keywords.
_GROUPS = {"render": "", "optimization": "optimize_", "output": ""}
#: Fields that are arguments, not keywords.
_ARGUMENTS = {"triangles", "simplified_mesh", "simplified_file_name"}
#: Fields of one value for all levels, and the field of as many values as are given.
_PER_LEVEL = {"max_d2": "level_max_d2"}

Path = tuple[str | None, FieldDescriptor]


def _options(kind: Descriptor) -> dict[str, Path]:
    """Every keyword of a kind of job: the group that its field stands in, if any, and the field."""
    found: dict[str, Path] = {}
    for name, field in kind.fields_by_name.items():
        if name in _GROUPS:
            for inner in field.message_type.fields:
                found[_GROUPS[name] + inner.name] = (name, inner)
        elif name in _PER_LEVEL:
            found[name] = (None, kind.fields_by_name[_PER_LEVEL[name]])
        elif name not in _ARGUMENTS and name not in _PER_LEVEL.values():
            found[name] = (None, field)
    return found


#: Every keyword, for messages and for help.
OPTIONS = sorted(_options(spec_pb2.SimplifySpec.DESCRIPTOR))


def simplify_spec(triangles: int | Iterable[int] = (), **options: Any) -> spec_pb2.SimplifySpec:
    """The specification of a simplification; what is not given, or None, takes its default.

    Enum values are written in lower case (`effort="fast"`), directions as three numbers
    (`custom_views=[(1, 0, 0)]`); fields of the optimization begin with `optimize_`
    (`optimize_max_evaluations=0`). What is a list may be one value (`max_d2=3`, `lock="border"`).
    """
    spec = spec_pb2.SimplifySpec()
    _assign(spec, spec.DESCRIPTOR.fields_by_name["triangles"], triangles)
    return _with_options(spec, options)


def optimize_spec(mesh: str, file_name: str, **options: Any) -> spec_pb2.OptimizeSpec:
    """The specification of the optimization of a mesh that is simplified already, likewise."""
    spec = spec_pb2.OptimizeSpec(simplified_mesh=mesh, simplified_file_name=file_name)
    return _with_options(spec, options)


def evaluate_spec(mesh: str, file_name: str, **options: Any) -> spec_pb2.EvaluateSpec:
    """The specification of the comparison of a simplified mesh with its original, likewise."""
    spec = spec_pb2.EvaluateSpec(simplified_mesh=mesh, simplified_file_name=file_name)
    return _with_options(spec, options)


def job_spec(work: Work) -> spec_pb2.JobSpec:
    """The same as the specification of a job, which says of what kind it is."""
    fields = spec_pb2.JobSpec.DESCRIPTOR.oneofs_by_name["kind"].fields
    kind: Any = {f.name: work for f in fields if f.message_type == work.DESCRIPTOR}
    return spec_pb2.JobSpec(**kind)


def _with_options(spec: _W, options: dict[str, Any]) -> _W:
    known = _options(spec.DESCRIPTOR)
    for name, value in options.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean `{near[0]}`?" if near else f"use {', '.join(sorted(known))}"
            raise TypeError(f"`{name}` is no option: {hint}")
        if value is not None:
            group, field = known[name]
            _assign(spec if group is None else getattr(spec, group), field, value)
    return spec


def enum_value(kind: EnumDescriptor, word: str) -> int:
    """The number of an enum value from its name without the prefix, in any case."""
    prefix = kind.values[0].name.removesuffix("UNSPECIFIED")
    value = kind.values_by_name.get(prefix + str(word).upper().replace("-", "_"))
    if value is None:
        words = ", ".join(v.name.removeprefix(prefix).lower() for v in kind.values[1:])
        raise ValueError(f"`{word}` is no {kind.name.lower()}: use {words}")
    return value.number


def _assign(message: Any, field: FieldDescriptor, value: Any) -> None:
    try:
        if field.enum_type is not None and field.is_repeated:
            words = value.split(",") if isinstance(value, str) else value
            numbers = [enum_value(field.enum_type, word) for word in words]
            getattr(message, field.name).extend(numbers)
        elif field.enum_type is not None:
            setattr(message, field.name, enum_value(field.enum_type, value))
        elif field.message_type is not None:
            rows = getattr(message, field.name)
            for x, y, z in value:
                rows.add(x=x, y=y, z=z)
        elif field.is_repeated:
            values = value if isinstance(value, Iterable) else [value]
            getattr(message, field.name).extend(values)
        else:
            setattr(message, field.name, value)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{field.name}: {error}") from error
