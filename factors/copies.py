"""``copy`` and ``pickle`` of factors on planes, which GTSAM's own archives corrupt or refuse.

The wheel's ``LocalOrientedPlane3Factor`` leaves what was measured out of its archive, and pickles without a word.
Python asks ``copyreg`` before it asks a class: importing `factors` registers there how such factors are taken apart and
put together, so that ``copy.copy``, ``copy.deepcopy`` and ``pickle`` of one factor give the same factor. Graphs and values
that hold planes are still refused by GTSAM with an error; `copy_graph` copies them.
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable
from typing import Any

import gtsam
import gtsam_unstable

from factors.archive import ArchiveError, dumps, loads
from spplanes._check import check_instance


def copy_graph(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Copies of a graph and of values that share nothing with the originals; numbers agree to 1e-15.

    `factors.archive.ArchiveError`: a factor that neither GTSAM nor this package can write.
    """
    check_instance("graph", graph, gtsam.NonlinearFactorGraph)
    return loads(dumps(graph, values))


def _taken_apart(factor: Any) -> tuple[Callable[[str], Any], tuple[str]]:
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(factor)
    try:
        return _put_together, (dumps(graph),)
    except ArchiveError as error:
        raise TypeError(f"cannot pickle {type(factor).__name__!r} object: {error}") from error


def _put_together(text: str) -> Any:
    return loads(text)[0].at(0)


for _kind in (gtsam_unstable.LocalOrientedPlane3Factor, gtsam.OrientedPlane3DirectionPrior, gtsam.CustomFactor):
    copyreg.pickle(_kind, _taken_apart)
