"""Argument checks and aligned arrays."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]


# Bytes: required for zero-copy exchange with JAX, and fits cache lines and vector instructions.
ALIGNMENT = 64
# Bytes of a block that small arrays share. The whole block stays in memory as long as one of them is used.
BLOCK = 16_384


def count(number: int, what: str) -> str:
    """Returns a number with what it counts, in the plural if needed."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def aligned(shape: tuple[int, ...]) -> Floats:
    """Returns a new float32 array, aligned to 64 bytes. Its values are undefined."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.__array_interface__["data"][0] % ALIGNMENT
    return memory[start : start + size].view(np.float32).reshape(shape)


class ArraySupply:
    """Returns new arrays of one shape, as `aligned` does. Small ones are parts of one block, which is faster."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        self._parts: Iterator[Floats] = iter(())

    def __call__(self) -> Floats:
        for part in self._parts:
            return part
        self._parts = self._block()
        return next(self._parts)

    def _block(self) -> Iterator[Floats]:
        stride = -(-4 * math.prod(self.shape) // ALIGNMENT) * ALIGNMENT
        count = max(BLOCK // stride, 1)
        memory = aligned((count * stride // 4,))
        return (np.ndarray(self.shape, np.float32, memory, place * stride) for place in range(count))

    def __reduce__(self) -> tuple[Any, ...]:
        return ArraySupply, (self.shape,)


def floats(what: str, values: ArrayLike, axes: str) -> Floats:
    """Converts values to a float32 array with the named axes, without a copy if they are one already."""
    count = axes.count(",") + 1
    if type(values) is np.ndarray and values.dtype == np.float32 and values.ndim == count and values.flags.carray:
        return values
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{what} are not an array: {error}") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{what} are {array.dtype}, allowed are float32 (other numbers are converted to it)")
    if array.ndim != count:
        raise ValueError(f"{what} have the shape {array.shape}, allowed are {count} axes: [{axes}]")
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["C", "A"])


def whole(what: str, value: Any, least: int, most: int) -> int:
    """Returns `value` as an int. Raises an error if it is not a whole number from `least` to `most`."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{what} is {type(value).__name__}, allowed is a whole number") from None
    if isinstance(value, bool) or not least <= number <= most:
        raise ValueError(f"{what} is {value}, allowed is {least} to {most}")
    return number


def number(what: str, value: Any, least: float, most: float) -> float:
    """Returns `value` as a float. Raises an error if it is not a number from `least` to `most`."""
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{what} is {type(value).__name__}, allowed is a number") from None
    if not least <= found <= most:
        raise ValueError(f"{what} is {value}, allowed is {least} to {most}")
    return found


def text(what: str, value: Any) -> str:
    """Returns `value` if it is a str without control characters or surrogates. Otherwise raises an error."""
    if not isinstance(value, str):
        raise TypeError(f"{what} is {type(value).__name__}, allowed is text")
    if any(ord(letter) < 32 or 0xD800 <= ord(letter) <= 0xDFFF for letter in value):
        raise ValueError(f"{what} holds a line break or another character that no name has")
    return value


def word(what: str, value: Any) -> str:
    """Returns a word or a whole number as text."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        return str(value)
    return text(what, value)
