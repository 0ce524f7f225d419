"""What is made or read when somebody looks at it: sequences that only grow, dataclasses and numbers on the disk."""

from __future__ import annotations

import os
from abc import abstractmethod
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Any, Self, TypeVar, overload

import numpy as np

from slam.errors import LogError
from spplanes._check import FloatArray

T = TypeVar("T")

#: So much of a log stays in memory, bytes; a longer one goes into the folder for temporary files (TMPDIR).
_IN_MEMORY_BYTES = 16 << 20


class Growing(Sequence[T]):
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

    def append(self, value: T) -> None:
        """Add one at the end."""
        raise TypeError(f"{type(self).__name__} does not grow")


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


class Spool:
    """Numbers put away one after another, without a name, gone with the process whatever ends it."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._file = SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES, prefix="spplanes-")  # noqa: SIM115  # as long as its scans
        self._end = 0

    def put(self, numbers: FloatArray) -> int:
        """Put numbers, shape (N,), away; returns their place. Raises `LogError` where there is no room for them."""
        place, data = self._end, numbers.tobytes()
        try:
            self._file.seek(place)
            self._file.write(data)
            self._file.flush()  # all of it is in the file, wherever this process may fork
        except OSError as error:
            problem = f"expected room for its scans in the folder for temporary files: {error.strerror or error}"
            raise LogError(self._source, problem) from error
        self._end += len(data)
        return place

    def get(self, place: int, count: int) -> FloatArray:
        """The numbers at a place, shape (count,)."""
        if self._end > _IN_MEMORY_BYTES:  # in a file, whose position processes that were forked would share
            data = os.pread(self._file.fileno(), 8 * count, place)
        else:
            self._file.seek(place)
            data = self._file.read(8 * count)
        if len(data) != 8 * count:
            raise LogError(self._source, "expected its scans in the folder for temporary files, found them cut off")
        return np.frombuffer(data, dtype=np.float64).copy()
