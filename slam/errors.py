"""Errors that name a file: what cannot be read, and readers whose package is missing."""

from __future__ import annotations

from pathlib import Path

#: What the sentence on a log that breaks off ends with, where the part before can be used.
KEEPS_THE_REST = "--keep-partial uses what comes before"


class LogError(ValueError):
    """A file that cannot be read as what it claims to be; the sentence names the file, and the line if there is one."""

    def __init__(self, path: Path | str, problem: str, *, line: int | None = None) -> None:
        where = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {problem}")
        self.path, self.line, self.problem = Path(path), line, problem


class MissingPackageError(LogError, ImportError):  # type: ignore[misc]  # both have a path
    """A format whose reader or writer needs a package that is not installed; the sentence says what to install."""

    def __init__(self, path: Path | str, package: str, extra: str, *, doing: str = "reading") -> None:
        super().__init__(path, f"{doing} this needs {package}: pip install 'spplanes[{extra}]'")
