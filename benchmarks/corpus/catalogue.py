"""Which drives the corpus holds: every kind of world, sensor, odometry and disturbance in several company."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from benchmarks.corpus.drives import DISTURBANCES, ODOMETRIES, WORLDS, Recipe
from benchmarks.corpus.handheld import HANDHELD, HANDHELD_WORD
from benchmarks.corpus.perturbed import PERTURBATIONS
from benchmarks.corpus.real import REAL, WHEELED

#: First word of the name of a real log.
REAL_WORD = "real"
#: Odometries that are not as the rig says, and disturbances.
_BAD_WHEELS = tuple(name for name in ODOMETRIES if name != "good")
_DISTURBED = tuple(name for name in DISTURBANCES if name != "none")
#: Drives with odometries that are not as the rig says, beside those of two worlds.
_MORE_WHEELS = (
    "loop/level/worse3 loop/level/biased bare/lidar16/absent bare/lidar16/worse3 bare/paper/worse3"
    " irregular/level/absent office/paper/absent loop/level/absent hall/depth/absent cluttered/lidar32/absent"
    " symmetric/lidar16/absent ramp/lidar16/absent irregular/turning16/absent office/turning32/absent"
)


@dataclass(frozen=True)
class Entry:
    """One drive of the corpus."""

    name: str  # a recipe's name, real/LOG, real/LOG/PERTURBATION, or one of `HANDHELD`
    seed: int  # which one of its kind; 0 for a real log as it is

    @property
    def kinds(self) -> list[str]:
        """What it counts for in the summary: each of its parts, but good odometry and no disturbance only together."""
        words = self.name.split("/")
        if words[0] in (REAL_WORD, HANDHELD_WORD):
            return [self.name]
        wrong = [word for word in words[2:] if word not in ("good", "none")]
        return [f"world {words[0]}", f"sensors {words[1]}", *(f"with {word}" for word in wrong or ["nothing wrong"])]


def _named(lines: Iterable[str]) -> list[str]:
    return [Recipe.parse(line).name for line in lines]


def simulated() -> list[str]:
    """Names of the simulated drives of a whole run: worlds by sensors, then all that may be wrong, in two worlds."""
    plain = [f"{world}/{sensors}" for world in WORLDS for sensors in ("level", "paper", "lidar32") if world != "ramp"]
    plain += ["ramp/lidar32", "ramp/lidar16", "ramp/depth", "ramp/paper"]
    plain += [f"{w}/{s}" for w in ("irregular", "cluttered") for s in ("pushbroom", "lidar16", "lidar64", "depth")]
    plain += ["irregular/turning16", "cluttered/turning32"]
    wheels = [f"{world}/{s}/{o}" for world, s in (("irregular", "lidar16"), ("office", "paper")) for o in _BAD_WHEELS]
    wheels += _MORE_WHEELS.split()
    wrong = [
        f"{world}/{sensors}/good/{what}"
        for world, sensors in (("irregular", "lidar16"), ("office", "level"), ("loop", "paper"))
        for what in _DISTURBED
    ]
    return _named(dict.fromkeys([*plain, *wheels, *wrong]))


#: Simulated drives of `--short`: each kind once.
_EACH_ONCE = (
    "irregular/lidar32 office/paper sloped/lidar16 loop/level cluttered/lidar16 glass/lidar16 bare/level"
    " symmetric/level ramp/lidar16 people/lidar16 hall/depth irregular/pushbroom"
    " irregular/lidar16/worse3 loop/level/biased office/lidar16/absent bare/lidar16/absent"
    " loop/level/undescribed irregular/level/absent irregular/lidar16/still irregular/lidar16/stops"
    " office/level/good/backwards office/level/good/noise0.3 irregular/paper/good/noise3"
    " office/level/good/half irregular/lidar16/good/fifth loop/level/good/reversed"
    " office/level/good/prior office/level/good/prior_start irregular/lidar16/good/prior_elsewhere"
)
SHORT = _named(_EACH_ONCE.split())
#: Real logs of `--short`.
SHORT_REAL = ("3dtk_corridor", "balm_hall", "loop5", "pcl_room", "tum_fr3_cabinet")
#: Real logs made worse: only where they are asked for, they take minutes each.
PERTURBED = [f"{REAL_WORD}/{log}/{kind}" for log in WHEELED for kind in PERTURBATIONS]


def corpus(seeds: Sequence[int], *, short: bool = False, kinds: Sequence[str] = ()) -> list[Entry]:
    """The drives of a run: real logs, then the simulated ones with the first seed, with the next, and so on.

    With `kinds` only drives with one of these words as a part of their name, or whose name matches one as a pattern; a
    whole name need not be in the catalogue, and a kind that no drive is of is a ValueError. Real logs made worse and
    cameras carried by hand are there by names, and by patterns that nothing else matches.
    """
    real = [f"{REAL_WORD}/{name}" for name in (SHORT_REAL if short else REAL)]
    names = [*real, *(SHORT if short else simulated())]
    if kinds:
        names = [name for kind in kinds for name in _of_kind(kind, names)]
    unseeded = set(names).intersection(f"{REAL_WORD}/{name}" for name in REAL)
    once, again = ([name for name in dict.fromkeys(names) if (name in unseeded) == one] for one in (True, False))
    return [*(Entry(name, 0) for name in once), *(Entry(name, seed) for seed in seeds for name in again)]


def drawn(count: int, seeds: Sequence[int]) -> list[Entry]:
    """So many drives out of all combinations there are, with as many seeds from the first on; the seed says which."""
    recipes, first = [one for one in Recipe.every() if _makes_sense(one)], seeds[0] if len(seeds) else 0
    chosen = [int(np.random.default_rng([first + k, 7]).integers(len(recipes))) for k in range(count)]
    return [Entry(recipes[index].name, first + k) for k, index in enumerate(chosen)]


def _makes_sense(recipe: Recipe) -> bool:
    """A push-broom laser alone is refused where nothing tells the motion; ramps are not for 2D lasers."""
    if recipe.sensors == "pushbroom" and recipe.odometry in ("absent", "still", "stops"):
        return False
    return not (recipe.sensors in ("level", "paper", "pushbroom") and recipe.world == "ramp")


def _of_kind(kind: str, names: Sequence[str]) -> list[str]:
    found = [name for name in names if kind in name.split("/") or fnmatchcase(name, kind)]
    found = found or [name for name in (*PERTURBED, *HANDHELD) if fnmatchcase(name, kind)]
    if found:
        return found
    if "/" in kind and not kind.startswith(f"{REAL_WORD}/"):
        return [Recipe.parse(kind).name]
    raise ValueError(f"kind: expected a part of a drive's name, a pattern or a whole name, got {kind!r}")
