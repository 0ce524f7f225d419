"""Changes that keep the form of an input: blind ones of single bytes seldom get past the first check of a format."""

import json
import re
import struct
from random import Random
from typing import Any

from tests.fuzz.target import NEXT_FILE

#: What is hard to be right about, as words and as numbers.
WORDS = (
    *b"0 -0 1 -1 2 3 255 65535 65536 2147483648 -9223372036854775809 18446744073709551616 1e999 1e308 1e155".split(),
    *b"1e60 1e18 1e7 1e-9 1e-160 5e-324 nan inf -inf 0.5 1_0 1,5 0x1p3 true null ~".split(),
    *b'"" [] {} x *a # ../x'.split(),
    *(b"", b"&a 1", b"!!int 1", b"- 1", b"\xff\xfe", b"\0", b"\xc2\xa0", b"a" * 300),
)
NUMBERS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-9, 1e-6, 1e3, 1e7, 1e18, 1e49, 1e51, 1e155, 1e308, 1e-155, 1e-308, 5e-324)
INTEGERS = (0, 1, 2, 3, 127, 128, 255, 256, 32767, 65535, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 53, (1 << 64) - 1)
PARTS = (None, True, False, -1, 0, 1, 10**12, 10**30, 0.5, 1e300, 1e-300, "", "x", [], {}, [0, 0, 0], [[0.0]])
#: Most that is looked at of a file, bytes.
_STRETCH = 1024
_PRINTED = frozenset((9, 10, 13, *range(32, 127)))
_TOKENS = re.compile(rb"([\s,;:=\"'\[\]{}()]+)")


def by_form(data: bytes, random: Random) -> bytes:
    """One of the files of an input, or a stretch of it, changed as its form asks for."""
    parts = data.split(NEXT_FILE)
    place = random.randrange(len(parts))
    part = parts[place]
    if part[:1] in (b"{", b"[") or part[1:2] in (b"{", b"["):
        parts[place] = tree(part, random)
    else:
        start = random.randrange(max(len(part) - _STRETCH, 0) + 1)
        stretch = part[start : start + _STRETCH]
        change = text if sum(map(_PRINTED.__contains__, stretch)) >= 0.9 * len(stretch) else binary
        parts[place] = part[:start] + change(stretch, random) + part[start + _STRETCH :]
    return NEXT_FILE.join(parts)


def text(data: bytes, random: Random) -> bytes:
    """Lines or words replaced, doubled, dropped or swapped."""
    if random.random() < 0.3:
        return b"".join(_rearranged(data.splitlines(keepends=True), random))
    tokens = _TOKENS.split(data)
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        place = random.randrange(len(tokens))
        tokens[place] = random.choice(WORDS) if random.random() < 0.7 else random.choice(tokens)
    return b"".join(tokens)


def floats(data: bytes, random: Random) -> bytes:
    """Numbers of eight bytes replaced, scaled, or taken from elsewhere."""
    numbers = list(struct.unpack(f"<{len(data) // 8}d", data[: len(data) // 8 * 8])) or [0.0]
    for _ in range(random.choice((1, 1, 2, 3, 8))):
        place, kind = random.randrange(len(numbers)), random.random()
        span = range(place, min(place + random.choice((1, 1, 1, 3, 9, 48)), len(numbers)))
        if kind < 0.4:
            number = random.choice(NUMBERS) * random.choice((1.0, 1.0, -1.0, float("nan"), float("inf")))
            for one in span:
                numbers[one] = number
        elif kind < 0.6:
            scale = random.choice((-1.0, 0.0, 2.0, 1e-3, 1e3, 1e-150, 1e150, 1.0 + 1e-15))
            for one in span:
                numbers[one] *= scale
        elif kind < 0.8:
            start = random.randrange(len(numbers))
            for one, value in zip(span, numbers[start:] + numbers[:start], strict=False):
                numbers[one] = value
        else:
            numbers[place] += random.gauss(0.0, random.choice((1e-12, 1e-3, 1.0)))
    return struct.pack(f"<{len(numbers)}d", *numbers)


def binary(data: bytes, random: Random) -> bytes:
    """A whole number of one to eight bytes, of either order, replaced or moved a little."""
    changed = bytearray(data or b"\0")
    for _ in range(random.choice((1, 1, 2, 4))):
        size, order = random.choice((1, 2, 4, 8)), random.choice(("little", "big"))
        place = random.randrange(len(changed))
        number = int.from_bytes(changed[place : place + size], order) + random.choice((-1, 1, -2, 4, 256))  # type: ignore[arg-type]
        if random.random() < 0.6:
            number = random.choice(INTEGERS)
        changed[place : place + size] = (number % (1 << 8 * size)).to_bytes(size, order)  # type: ignore[arg-type]
    return bytes(changed)


def tree(data: bytes, random: Random) -> bytes:
    """Parts of a text of JSON replaced, dropped, doubled or swapped; what follows a NUL stays."""
    head, nul, rest = data.partition(b"\0")
    try:
        found = json.loads(head)
    except (ValueError, RecursionError):
        return text(data, random)
    places: list[tuple[Any, Any]] = []
    _collect(found, places)
    for _ in range(random.choice((1, 1, 2, 3))):
        if not places:
            break
        holder, key = random.choice(places)
        other, there = random.choice(places)
        try:
            if random.random() < 0.6:
                holder[key] = random.choice(PARTS)
            elif random.random() < 0.5:
                holder[key] = other[there]
            elif isinstance(holder, list) and random.random() < 0.5:
                holder.append(holder[key])
            else:
                del holder[key]
        except (KeyError, IndexError):
            continue  # an earlier change took it away
    try:
        return json.dumps(found).encode() + nul + rest
    except (ValueError, RecursionError):  # it holds itself now
        return data


def _collect(found: Any, places: list[tuple[Any, Any]]) -> None:
    for key, value in found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ():
        places.append((found, key))
        _collect(value, places)


def _rearranged(parts: list[bytes], random: Random) -> list[bytes]:
    if not parts:
        return [random.choice(WORDS)]
    first, second = random.randrange(len(parts)), random.randrange(len(parts))
    kind = random.randrange(4)
    if kind == 0:
        del parts[first]
    elif kind == 1:
        parts.insert(second, parts[first])
    elif kind == 2:
        parts[first], parts[second] = parts[second], parts[first]
    else:
        parts[first] = random.choice(WORDS) + b"\n"
    return parts
