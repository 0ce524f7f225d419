"""What is made or read when somebody looks at it: sequences that only grow, dataclasses that wait on the disk."""

from __future__ import annotations

from abc import abstractmethod
from array import array
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from dataclasses import MISSING, fields, replace
from typing import Any, NoReturn, Self, TypeVar, overload

T = TypeVar("T")


class Growing(MutableSequence[T]):
    """A sequence whose elements are made when somebody looks at them; without an `append` of its own it never grows."""

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


class Stored:
    """First base of a variant of a frozen dataclass, its second, of which some fields are read each time one asks.

    Copies by `dataclasses.replace` are in memory.

    Args:
        known: the fields that are there; of those neither known nor read the default counts.
        readers: by the name of a field what reads it at a place.
        place: where this one's are.
    """

    def __init_subclass__(cls) -> None:
        for field in fields(cls):  # type: ignore[arg-type]  # its second base is a dataclass
            setattr(cls, field.name, _Read(field.name, None if field.default is MISSING else field.default))

    def __new__(cls, *given: Any, **changed: Any) -> Any:
        """Of all fields by name, as `dataclasses.replace` gives them, one in memory."""
        return cls.__bases__[1](**changed) if changed else super().__new__(cls)

    def __init__(self, known: Mapping[str, Any], readers: Mapping[str, Callable[[int], Any]], place: int = 0) -> None:
        for name, value in {**known, "_readers": readers, "_place": place}.items():
            object.__setattr__(self, name, value)  # frozen: set once, here

    def loaded(self) -> Self:
        """The same in memory."""
        return replace(self)  # type: ignore[type-var]

    def __repr__(self) -> str:
        told = (f"{name}={vars(self)[name]!r}" for name in ("stamp_ns", "sensor") if name in vars(self))
        return f"{type(self).__name__}({', '.join(told)})"  # without reading it


class _Read:
    """A field of a `Stored` that is not known."""

    def __init__(self, name: str, default: Any) -> None:
        self._name, self._default = name, default

    def __get__(self, owner: Any, kind: type) -> Any:
        if owner is None:
            return self
        read = owner._readers.get(self._name)
        return self._default if read is None else read(owner._place)
