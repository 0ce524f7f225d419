"""The walls of one laser scan, with how well each is known.

A room of 6 x 4 m with a pillar in it, seen by a laser of 360 beams with 10 mm of range noise: four walls come out,
each with the standard deviation of its direction and of its distance, beside the true values.
"""

import numpy as np

from spplanes import LineConfig, extract_lines

SIGMA_M = 0.01
WALLS = {"east": (0.0, 4.0), "north": (90.0, 3.0), "west": (180.0, 2.0), "south": (-90.0, 1.0)}
PILLAR = (1.5, 0.8, 0.2)


def simulate(angles: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranges (B,) of a laser at the origin: the nearest of four walls and a pillar; a tenth of the beams is lost."""
    with np.errstate(divide="ignore"):
        reach = np.array([rho / np.cos(angles - np.radians(alpha)) for alpha, rho in WALLS.values()])
    ranges = np.where(reach > 0, reach, np.inf).min(axis=0)
    x, y, radius = PILLAR
    along = x * np.cos(angles) + y * np.sin(angles)
    chord = radius**2 - (x * np.sin(angles) - y * np.cos(angles)) ** 2
    hit = (chord > 0) & (along > 0)
    ranges[hit] = along[hit] - np.sqrt(chord[hit])
    ranges += rng.normal(0.0, SIGMA_M, angles.size)
    ranges[rng.random(angles.size) < 0.1] = np.nan
    return ranges


def main() -> None:
    """Extract the lines and print them beside the truth."""
    angles = np.radians(np.arange(-180.0, 180.0))
    ranges = simulate(angles, np.random.default_rng(0))
    lines = extract_lines(ranges, angles, sigma=SIGMA_M, config=LineConfig(range_max=20.0))
    print(f"{len(lines)} lines from {np.isfinite(ranges).sum()} returns of {angles.size} beams; the pillar is none")
    print("wall   alpha (true)            rho (true)                 length  beams  chi2/dof")
    for line in lines:
        name, (alpha, rho) = min(WALLS.items(), key=lambda wall: abs(wall[1][1] - line.rho))
        sd_alpha, sd_rho = np.degrees(np.sqrt(line.covariance[0, 0])), 1e3 * np.sqrt(line.covariance[1, 1])
        print(
            f"{name:6} {np.degrees(line.alpha):8.2f} ± {sd_alpha:.2f}° ({alpha:5.0f}°)  "
            f"{line.rho:.4f} m ± {sd_rho:.1f} mm ({rho:.1f} m)  "
            f"{line.length:5.2f} m  {line.indices.size:5}  {line.chi2 / line.dof:.2f}"
        )


if __name__ == "__main__":
    main()
