"""A reader of the binary PLY files that are written here, apart from the one that is tested."""

from pathlib import Path

import numpy as np

TYPES = {"uchar": "u1", "int": "<i4", "double": "<f8", "float": "<f4"}


def read_tables(path: Path) -> dict[str, np.ndarray]:
    """Elements by name; lists must be as long in every row as in the first."""
    data = path.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:start].decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    elements: list[tuple[str, int, list]] = []
    for words in (line.split() for line in lines[2:-1]):
        if words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[1] == "list":
            elements[-1][2].extend([(words[4] + " n", TYPES[words[2]]), (words[4], TYPES[words[3]], (3,))])
        else:
            elements[-1][2].append((words[2], TYPES[words[1]]))
    tables = {}
    for name, count, fields in elements:
        tables[name] = np.frombuffer(data, np.dtype(fields), count, start)
        start += tables[name].nbytes
        for field in (one for one in tables[name].dtype.names if one.endswith(" n")):
            assert (tables[name][field] == 3).all()
    assert start == len(data)
    return tables
