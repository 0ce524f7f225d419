"""Gzip that grows out of proportion is refused wherever gzip is read; names are any names."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from slam.errors import LogError
from slam.io import raw
from slam.io.carmen import read_carmen
from slam.io.load import load
from slam.io.raw import check_ratio, read_unpacked
from slam.io.trajectories import read_tum


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """64 MiB take seconds to make."""
    monkeypatch.setattr(raw, "HARMLESS_BYTES", 1 << 18)


def bomb(path: Path, line: bytes) -> Path:
    path.write_bytes(gzip.compress(line * ((1 << 20) // len(line)), compresslevel=9))
    assert path.stat().st_size * raw.MOST_GROWTH < 1 << 20
    return path


BOMBS = {
    "log.clf.gz": b"# nothing at all\n",
    "blank.clf.gz": b"\n",
    "Größe 1.log.gz": b"PARAM a_very_long_parameter 1 \n",
    "scan000.3d.gz": b"1 2 3\n",
    "poses.tum.gz": b"# 1 2 3 4 5 6 7 8\n",
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_while_it_unpacks(name: str, tmp_path: Path, small_limit: None):
    path = bomb(tmp_path / name, BOMBS[name])
    read = read_unpacked if "3d" in name else read_tum if "tum" in name else read_carmen
    with pytest.raises(LogError, match=r"expected sensor data, got \d+ bytes that grow to 0 MiB or more: refused"):
        read(path)


def test_what_grows_as_logs_do_passes():
    check_ratio(Path("x"), raw.HARMLESS_BYTES, 1)
    check_ratio(Path("x"), 10 * raw.HARMLESS_BYTES, raw.HARMLESS_BYTES)
    with pytest.raises(LogError, match=r"got 1000 bytes that grow to 640 MiB"):
        check_ratio(Path("x"), 10 * raw.HARMLESS_BYTES, 1000)


NO_LOGS = {
    "a cloud": ("one.ply", b"ply\n", "expected a log, got one cloud: give it to `spplanes fit`"),
    "a picture": ("a.png", b"\x89PNG", "expected a log, got one cloud|expected a CARMEN record"),
    "an empty file": ("empty.clf", b"", "expected a CARMEN log with laser records, got none"),
    "binary": ("x.clf", bytes(range(256)) * 9, "expected"),
}


@pytest.mark.parametrize("case", NO_LOGS)
def test_what_is_no_log(case: str, tmp_path: Path):
    name, data, sentence = NO_LOGS[case]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(LogError, match=sentence):
        load(tmp_path / name)


def test_the_folder_of_a_run_is_no_log(tmp_path: Path):
    (tmp_path / "planes.json").write_text("{}")
    (tmp_path / "map.ply").write_text("ply\n")
    with pytest.raises(LogError, match="expected a log, got the folder of a run"):
        load(tmp_path)
