"""Sequences that only grow at their end, in less memory than a list of objects."""

from __future__ import annotations

from abc import abstractmethod
from array import array
from collections.abc import MutableSequence, Sequence
from typing import Any, NoReturn, TypeVar, overload

T = TypeVar("T")


class Growing(MutableSequence[T]):
    """A sequence whose elements are made when somebody looks at them."""

    @abstractmethod
    def append(self, value: T) -> None:
        """Add one at the end."""

    @abstractmethod
    def at(self, index: int) -> T:
        """The element at an index from 0 on."""

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self.at(one) for one in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"index: expected one of {len(self)} elements, got {index}")
        return self.at(index % len(self))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def insert(self, index: int, value: T) -> NoReturn:
        """Not possible."""
        raise TypeError(f"{type(self).__name__} grows at its end only")

    def __setitem__(self, index: Any, value: Any) -> NoReturn:
        raise TypeError(f"{type(self).__name__} grows at its end only")

    def __delitem__(self, index: Any) -> NoReturn:
        raise TypeError(f"{type(self).__name__} grows at its end only")


class Rows(Growing[tuple[Any, ...]]):
    """Rows of numbers, column by column: of each a code of the module `array`."""

    def __init__(self, codes: str) -> None:
        self._columns = tuple(array(code) for code in codes)

    def __len__(self) -> int:
        return len(self._columns[0])

    def append(self, value: tuple[Any, ...]) -> None:
        """Add a row."""
        for column, number in zip(self._columns, value, strict=True):
            column.append(number)

    def at(self, index: int) -> tuple[Any, ...]:
        """One row, as Python's own numbers."""
        return tuple(column[index] for column in self._columns)
