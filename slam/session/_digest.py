"""Checksums of a session: every record's depends on all before it, so nothing can change, vanish or swap unseen."""

from __future__ import annotations

import hashlib
from pathlib import Path

_SIZE = 16
#: Files up to this are hashed whole; of larger ones this much at either end, bytes.
_WHOLE = 64 << 20


def digest(*parts: bytes | str | int | None) -> bytes:
    """Checksum of a sequence of parts, each with its length, so that no two sequences look the same."""
    state = hashlib.blake2b(digest_size=_SIZE)
    for part in parts:
        data = b"" if part is None else part if isinstance(part, bytes) else str(part).encode()
        state.update(f"{'-' if part is None else len(data)}:".encode())
        state.update(data)
    return state.digest()


def fingerprint(path: Path) -> dict[str, int | str]:
    """Size and checksum of a log: of its files in order of their names, the largest only of their two ends.

    Raises:
        OSError: one of them cannot be read.
    """
    files = sorted(one for one in path.iterdir() if one.is_file()) if path.is_dir() else [path]
    state, total = hashlib.blake2b(digest_size=_SIZE), 0
    for file in files:
        size = file.stat().st_size
        total += size
        state.update(f"{file.name if path.is_dir() else ''}:{size};".encode())
        with file.open("rb") as stream:
            for start in (0,) if size <= 2 * _WHOLE else (0, size - _WHOLE):
                stream.seek(start)
                left = min(size, 2 * _WHOLE) if size <= 2 * _WHOLE else _WHOLE
                while left > 0 and (block := stream.read(min(left, 1 << 20))):
                    state.update(block)
                    left -= len(block)
    return {"bytes": total, "blake2b": state.hexdigest()}
