"""Plain values as bytes and back, to the last bit: what components keep beside their variables.

JSON, with arrays, bytes and tuples marked as such. Nothing is run when it is read.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

_KIND = "exlinn:kind"


def pack(value: object) -> bytes:
    """Bytes of a value made of None, booleans, numbers, texts, bytes, arrays, containers and dataclasses.

    Raises:
        NotImplementedError: there is something else in it.
    """
    return json.dumps(_mark(value)).encode()


def unpack(data: bytes, records: Iterable[type] = ()) -> Any:
    """The value that `pack` was given.

    Args:
        data: what `pack` gave.
        records: the dataclasses that may be in it.
    """
    known = {record.__name__: record for record in records}
    return json.loads(data, object_hook=lambda mapping: _restore(mapping, known))


def _mark(value: object) -> Any:
    """A value in JSON's types."""
    if isinstance(value, np.generic):
        return {_KIND: "scalar", "array": _mark(np.asarray(value))}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, list):
        return [_mark(v) for v in value]
    if isinstance(value, tuple):
        return {_KIND: "tuple", "items": [_mark(v) for v in value]}
    if isinstance(value, bytes):
        return {_KIND: "bytes", "data": base64.b64encode(value).decode()}
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        data = base64.b64encode(value.tobytes()).decode()
        return {_KIND: "array", "dtype": value.dtype.str, "shape": list(value.shape), "data": data}
    if isinstance(value, dict) and all(isinstance(k, str) for k in value) and _KIND not in value:
        return {k: _mark(v) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _mark(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {_KIND: "record", "name": type(value).__name__, "fields": fields}
    raise NotImplementedError(f"its state holds a {type(value).__name__}, which cannot be written as bytes")


def _restore(mapping: dict[str, Any], records: Mapping[str, type]) -> Any:
    """What a marked mapping stands for."""
    match mapping.get(_KIND):
        case "tuple":
            return tuple(mapping["items"])
        case "bytes":
            return base64.b64decode(mapping["data"])
        case "record":
            return records[mapping["name"]](**mapping["fields"])
        case "scalar":
            return mapping["array"][()]
        case "array":
            flat = np.frombuffer(base64.b64decode(mapping["data"]), dtype=mapping["dtype"])
            return flat.reshape(mapping["shape"]).copy()
    return mapping
