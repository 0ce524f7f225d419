"""Does adding scans get slower? `PlaneMapper` on a way of 10,000 scans, up and down the same corridor.

Run as ``python -m benchmarks.steady``. A strip of scans is segmented when it is full, so times are those of strips.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks._measure import Row
from benchmarks._memory import process_peak_mb
from benchmarks._table import plain
from spplanes import MapperConfig, PlaneMapper

SCANS, BEAMS = 10_000, 121


def run(scans: int = SCANS) -> list[Row]:
    """A row for every tenth of the way."""
    mapper, per_scan, rows = PlaneMapper(MapperConfig(outline_cell_m=0.5)), [], []
    before, strip = process_peak_mb(), mapper.config.strip_scans
    ends = [strip * (scans * k // (10 * strip)) for k in range(1, 11)]
    taken = []
    for k, (points, covariances) in enumerate(way(ends[-1]), start=1):
        start = time.process_time()
        mapper.add_scan(points, covariances)
        taken.append(time.process_time() - start)
        if k in ends:
            per_scan.append(1e6 * np.array(taken).reshape(-1, strip).mean(axis=1))
            taken = []
            rows.append(
                {
                    "scans": f"up to {k}",
                    "us a scan": float(np.median(per_scan[-1])),
                    "of the first tenth": float(np.median(per_scan[-1]) / np.median(per_scan[0][1:])),
                    "planes": len(mapper.planes),
                    "map KB": mapper.memory_bytes / 1024.0,
                    "peak memory MB": process_peak_mb() - before,
                }
            )
    return rows


def way(scans: int):
    """Points and covariances of every scan of a corridor 2 m wide and 1.5 m high above the laser."""
    rng, angles = np.random.default_rng(0), np.linspace(-np.pi / 2, np.pi / 2, BEAMS)
    u = np.column_stack((np.zeros(BEAMS), np.sin(angles), np.cos(angles)))
    ranges = np.minimum(1.0 / np.abs(u[:, 1]).clip(1e-9), 1.5 / u[:, 2].clip(1e-9))
    covariances = 1e-4 * u[:, :, None] * u[:, None, :] + 1e-8 * np.eye(3)
    for k in range(scans):
        yield (ranges + 0.01 * rng.standard_normal(BEAMS))[:, None] * u + [0.03 * (k % 500), 0.0, 0.0], covariances


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
