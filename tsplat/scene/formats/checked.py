"""Reading bytes and JSON that may be broken or hostile: every size is checked against what is there before it is used."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

T = TypeVar("T")
REQUIRED: Any = object()
MAX_REASON = 400                # characters: it may quote the file


def malformed(path: str | os.PathLike[str], offset: int, reason: str) -> ValueError:
    """The error for a file that is not what it should be: one line with the file, where in it, and why."""
    reason = reason.partition("\n")[0]
    return ValueError(f"{os.fspath(path)}: at byte {offset}: {reason if len(reason) <= MAX_REASON else reason[:MAX_REASON] + '...'}")


class Reader:
    """Bytes of a file from front to back.

    Args:
        path: the file, for errors.
        data: its bytes, or a part of them.
        start: where in the file `data` begins, for errors.
    """

    def __init__(self, path: Path, data: bytes, start: int = 0) -> None:
        self.path, self.data, self.start, self.position = path, data, start, 0

    @property
    def offset(self) -> int:
        """Where in the file the next byte is."""
        return self.start + self.position

    def take(self, size: int, what: str) -> bytes:
        """The next `size` bytes; ValueError where fewer are left."""
        left = len(self.data) - self.position
        if left < size:
            raise malformed(self.path, self.offset, f"truncated: expected {size} bytes of {what}; found {left}")
        self.position += size
        return self.data[self.position - size:self.position]

    def array(self, dtype: DTypeLike, shape: tuple[int, ...], what: str) -> NDArray[Any]:
        """The next numbers, read-only; ValueError where fewer bytes are left than they need."""
        return np.frombuffer(self.take(math.prod(shape) * np.dtype(dtype).itemsize, what), dtype).reshape(shape)

    def end(self) -> None:
        """ValueError where bytes are left."""
        left = len(self.data) - self.position
        if left:
            raise malformed(self.path, self.offset, f"oversized: expected the end; found {left} more bytes")


class Json:
    """A value in a JSON text that knows where it is, so that a wrong one is named in the error.

    Args:
        path: the file, for errors.
        value: the decoded value.
        offset: where in the file the text begins.
        name: of the value, such as `accessors[2].count`; empty for the whole text.
    """

    def __init__(self, path: Path, value: Any, offset: int, name: str = "") -> None:
        self.path, self.value, self.offset, self.name = path, value, offset, name

    @classmethod
    def parse(cls, path: Path, data: bytes, offset: int = 0) -> Json:
        """Decode the JSON object that begins at `offset` of the file; ValueError if it is none."""
        try:
            value = json.loads(data.decode("utf-8"))
        except json.JSONDecodeError as error:
            raise malformed(path, offset + error.pos, f"expected JSON; {error.msg}") from None
        except (ValueError, RecursionError) as error:                       # not UTF-8, an endless number, nested too deep
            raise malformed(path, offset, f"expected JSON; {str(error) or 'it is nested too deep'}") from None
        return cls(path, value, offset)._checked(dict)

    def wrong(self, reason: str) -> ValueError:
        """The error for this value."""
        return malformed(self.path, self.offset, f"{self.name}: {reason}" if self.name else reason)

    def get(self, key: str, kind: type[T], default: T = REQUIRED) -> T:
        """Member `key` as a plain value of type `kind` (an int is a float, too)."""
        if key not in self._checked(dict).value and default is not REQUIRED:
            return default
        value: T = self.at(key)._checked(kind).value
        return value

    def at(self, key: str | int) -> Json:
        """Member `key` of this object, or element `key` of this array."""
        inside = self.value
        if isinstance(key, str):
            if not isinstance(inside, dict) or key not in inside:
                raise self.wrong(f"expected an object with {key!r}")
            return Json(self.path, inside[key], self.offset, f"{self.name}.{key}".lstrip("."))
        if not isinstance(inside, list) or not 0 <= key < len(inside):
            raise self.wrong(f"expected an array with an element {key}")
        return Json(self.path, inside[key], self.offset, f"{self.name}[{key}]")

    def numbers(self, key: str, count: int) -> NDArray[np.float64]:
        """Member `key` as `[count]` finite numbers."""
        member = self.at(key)
        values = member._checked(list).value
        if len(values) != count or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
            raise member.wrong(f"expected {count} numbers")
        try:
            array = np.array(values, dtype=np.float64)
        except OverflowError:                                               # an int beyond 1e308
            array = np.full(count, np.inf)
        if not np.isfinite(array).all():
            raise member.wrong("expected finite numbers")
        return array

    def _checked(self, kind: type) -> Json:
        kinds = (int, float) if kind is float else (kind,)
        if not isinstance(self.value, kinds) or (isinstance(self.value, bool) and kind is not bool):
            raise self.wrong(f"expected {kind.__name__}; got {type(self.value).__name__}")
        return self
