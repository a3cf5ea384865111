"""Argument checks: bad input gets an error that names the argument, what came and what is expected, before any work."""

from __future__ import annotations

from collections.abc import Sequence
from types import EllipsisType

import torch
from torch import Tensor

NUMBERS = (int, float, torch.SymInt, torch.SymFloat)
SIZES = (int, torch.SymInt)
"""Tuples, which isinstance takes in 0.1 us; to make a union, as in `int | float`, takes 1 each time."""


def _shape_text(shape: Sequence[int | str | EllipsisType]) -> str:
    return "[" + ", ".join("..." if s is ... else str(s) for s in shape) + "]"


def _fits(got: Sequence[int], want: Sequence[int | str | EllipsisType]) -> bool:
    if want and want[0] is ...:
        want = want[1:]
        got = got[len(got) - len(want):] if len(got) >= len(want) else ()
    return len(got) == len(want) and all(isinstance(w, str) or g == w for g, w in zip(got, want, strict=True))


def check_tensor(name: str, value: object, shape: Sequence[int | str | EllipsisType], *, like: Tensor | None = None) -> None:
    """Check that `value` is a floating-point tensor of `shape`: sizes, names of free sizes, or a leading `...`.

    `like` is another tensor that must have the same dtype and device.
    """
    if (like is not None and isinstance(value, Tensor) and value.shape == shape and value.dtype == like.dtype
            and value.device == like.device and like.is_floating_point()):
        return                                          # most are right: 1 us instead of 2, 6 times in a call of rasterize
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a torch.Tensor of shape {_shape_text(shape)}; got {type(value).__name__}")
    if not value.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point tensor; got dtype {value.dtype}")
    if not _fits(value.shape, shape):
        raise ValueError(f"{name}: expected shape {_shape_text(shape)}; got {list(value.shape)}")
    if like is not None and value.dtype != like.dtype:
        raise TypeError(f"{name}: expected dtype {like.dtype}, as the other arguments have; got {value.dtype}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, where the other arguments are; got {value.device}")


def check_number(name: str, value: object, expected: str) -> None:
    """Check that `value` is an int or a float; `expected` says which."""
    if not isinstance(value, NUMBERS) or isinstance(value, bool):
        raise TypeError(f"{name}: expected {expected}; got {value!r}")


def check_size(name: str, value: object) -> None:
    """Check that `value` is an int of at least 1."""
    if not isinstance(value, SIZES) or isinstance(value, bool):
        raise TypeError(f"{name}: expected an int of at least 1; got {value!r}")
    if value < 1:
        raise ValueError(f"{name}: expected at least 1; got {value}")


def check_flag(name: str, value: object) -> None:
    """Check that `value` is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name}: expected True or False; got {value!r}")


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Check that `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, choices))}; got {value!r}")
