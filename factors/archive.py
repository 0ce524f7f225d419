"""Graphs to text and back: what GTSAM's own archives cannot do with planes.

Of the gtsam 4.3.0 wheel neither plane factor is registered for polymorphic archives, so a graph that holds one does
not survive ``NonlinearFactorGraph.serialize``; nor do values that hold an ``OrientedPlane3``; and a custom factor
never does. Here native plane factors are archived by what they measured, our custom factors as recipes, all others by
GTSAM. The text is JSON; numbers come back to 1e-15.

Worse, ``copy`` and ``pickle`` of a ``LocalOrientedPlane3Factor`` leave what was measured out, without a word. Python
asks ``copyreg`` before it asks a class: importing `factors` registers there how one factor is
taken apart and put together.
"""

from __future__ import annotations

import copyreg
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np

from factors._check import held, told_key
from factors._custom import Recipe, VelocityRecipe, describe
from factors.robust import resolve_robust
from spplanes._check import check_instance

_FORMAT = "spplanes-graph/1"


class ArchiveError(ValueError):
    """A graph that cannot be written, or a text that is not one of ours; the sentence says which factor or why."""


def dumps(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values | None = None) -> str:
    """Graph and values as text; empty slots of the graph stay empty.

    ArchiveError: a factor (somebody else's custom factor) or a value that neither GTSAM nor this package can write.
    """
    check_instance("graph", graph, gtsam.NonlinearFactorGraph)
    if values is not None:
        check_instance("values", values, gtsam.Values)
    factors = [_written(graph.at(i), i) if graph.exists(i) else None for i in range(graph.size())]
    document = {"format": _FORMAT, "factors": factors, "values": None if values is None else _values(values)}
    return json.dumps(document, default=np.ndarray.tolist)


def loads(text: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Inverse of `dumps`; values are empty where none were written."""
    try:
        document = json.loads(text)
        known = document.get("format") == _FORMAT
    except (ValueError, AttributeError, TypeError) as error:
        raise ArchiveError(f"text: expected a graph written by dumps, got no such document ({error})") from error
    if not known:
        raise ArchiveError(f"text: expected format {_FORMAT}, got {document.get('format')!r}")
    try:
        graph = gtsam.NonlinearFactorGraph()
        graph.resize(len(document["factors"]))
        for i, written in enumerate(document["factors"]):
            if written is not None:
                graph.replace(i, _read(written))
        return graph, _read_values(document["values"])
    except (LookupError, TypeError, ValueError, AttributeError, StopIteration, RuntimeError) as error:
        why = " ".join(str(error).split())[:80]
        raise ArchiveError(f"text: expected all of a graph, got a part of one or other ({why})") from error


def copy_graph(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Copies of a graph and of values that share nothing with the originals; numbers agree to 1e-15.

    ArchiveError: a factor or a value that neither GTSAM nor this package can write.
    """
    return loads(dumps(graph, values))


def rekeyed(factor: Any, names: Mapping[int, int], homes: Mapping[int, tuple[int, int]] | None = None) -> Any:
    """A copy of a factor over other variables, as where graphs become one.

    Args:
        factor: any that this package or GTSAM makes.
        names: new keys by old ones; a key that is not in it stays.
        homes: of landmarks that turn out to be others, by their old keys: the new (plane, anchor). A plane seen from
            the pose that it lived at becomes one seen from there and living elsewhere.

    ArchiveError: a factor that neither GTSAM nor this package can take apart, or that relates a landmark with a new
    home to another landmark.
    """
    homes = homes or {}
    if isinstance(factor, gtsam.CustomFactor):
        recipe = describe(factor)
        if recipe is None:
            raise ArchiveError("factor: expected one made here, got another CustomFactor")
        if len(recipe.landmark_keys) > 1 and homes.keys() & set(recipe.landmark_keys):
            raise ArchiveError("factor: expected one of a single plane, got one that relates a plane with a new home")
        return recipe.rekeyed(names, homes).factor()
    keys = list(factor.keys())
    named = [names.get(key, key) for key in keys]
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor):
        if keys[-1] in homes:
            named[2], named[1] = homes[keys[2]]
        if named[0] == named[1]:
            raise ArchiveError(
                "factor: expected a plane that lives elsewhere, got one that comes home to where it is seen"
            )
        return _read(_written(factor, 0), named)
    if set(keys) & set(homes):
        raise ArchiveError(
            f"factor: expected one that says where its plane is seen from, got a {type(factor).__name__}"
        )
    if isinstance(factor, gtsam.OrientedPlane3DirectionPrior):
        return _read(_written(factor, 0), named)
    return factor.rekey(named)


def _written(factor: gtsam.NonlinearFactor, index: int) -> dict[str, Any]:
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor):
        return {"plane": _native(factor, gtsam.PriorFactorPoint3)}
    if isinstance(factor, gtsam.OrientedPlane3DirectionPrior):
        return {"direction": _native(factor, gtsam.PriorFactorPoint2)}
    if isinstance(factor, gtsam.CustomFactor):
        recipe = describe(factor)
        if recipe is None:
            raise ArchiveError(f"factor {index}: expected a factor that can be archived, got a foreign CustomFactor")
        plain = {**vars(recipe), "robust": resolve_robust(recipe.robust, recipe.dof)}
        return {"velocity" if isinstance(recipe, VelocityRecipe) else "custom": plain}
    try:
        return {"gtsam": _alone(factor).serialize()}
    except RuntimeError as error:
        kind = type(factor).__name__
        raise ArchiveError(f"factor {index}: GTSAM cannot archive a {kind} ({str(error).splitlines()[0]})") from error


def _read(written: dict[str, Any], keys: Sequence[int] | None = None) -> gtsam.NonlinearFactor:
    """The factor; a native one of planes over other keys where they are given."""
    kind, content = next(iter(written.items()))
    if kind == "custom":
        return Recipe.of(content).factor()
    if kind == "velocity":
        return VelocityRecipe.of(content).factor()
    if kind == "gtsam":
        return _from_alone(content)
    noise = _from_alone(content["noise"]).noiseModel()
    measured, names = np.array(content["measured"]), content["keys"] if keys is None else keys
    if kind == "plane":
        return gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, *names)
    return gtsam.OrientedPlane3DirectionPrior(names[0], np.array([*measured[:3], 0.0]), noise)


def _native(factor: gtsam.NoiseModelFactor, carrier: type) -> dict[str, Any]:
    """A factor of the wheel that cannot be archived: its noise travels in a ``carrier`` that can.

    GTSAM does not show the measured plane either, and leaves it out of the factor's own archive. With the poses at
    the origin the error at the planes (axis, 0) is a column of B^T, and the measured distance below: the normal is the
    cross product of the rows of B^T.
    """
    keys = list(factor.keys())
    values = gtsam.Values()
    for key in keys[:-1]:
        values.insert(key, gtsam.Pose3())
    errors = []
    for axis in np.eye(3):
        values.insert_or_assign(keys[-1], gtsam.OrientedPlane3(np.array([*axis, 0.0])))
        errors.append(factor.unwhitenedError(values))
    columns = np.column_stack(errors)
    distance = columns[2, 0] if len(columns) == 3 else 0.0
    measured = [*np.cross(columns[0], columns[1]), distance]
    noise = _alone(carrier(0, np.zeros(len(columns)), factor.noiseModel())).serialize()
    return {"keys": keys, "measured": measured, "noise": noise}


def _alone(factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(factor)
    return graph


def _from_alone(text: str) -> Any:
    graph = gtsam.NonlinearFactorGraph()
    graph.deserialize(text)
    return graph.at(0)


def _values(values: gtsam.Values) -> dict[str, Any]:
    found = {key: held(values.atOrientedPlane3, key) for key in list(values.keys())}
    planes = {key: plane.planeCoefficients().tolist() for key, plane in found.items() if plane is not None}
    others = [key for key in found if key not in planes]
    try:
        return {"planes": planes, "others": values.extract(others).serialize()}
    except RuntimeError as error:
        foreign = [key for key in others if held(lambda one: values.extract([one]).serialize(), key) is None]
        told = ", ".join(map(told_key, foreign))
        raise ArchiveError(f"values: GTSAM cannot archive {told} ({str(error).splitlines()[0]})") from error


def _read_values(written: dict[str, Any] | None) -> gtsam.Values:
    values = gtsam.Values()
    if written is not None:
        values.deserialize(written["others"])
        for key, coefficients in written["planes"].items():
            values.insert(int(key), gtsam.OrientedPlane3(np.array(coefficients)))
    return values


def _taken_apart(factor: Any) -> tuple[Callable[[str], Any], tuple[str]]:
    try:
        return _put_together, (dumps(_alone(factor)),)
    except ArchiveError as error:
        raise TypeError(f"cannot pickle {type(factor).__name__!r} object: {error}") from error


def _put_together(text: str) -> Any:
    return loads(text)[0].at(0)


for _kind in (gtsam_unstable.LocalOrientedPlane3Factor, gtsam.OrientedPlane3DirectionPrior, gtsam.CustomFactor):
    copyreg.pickle(_kind, _taken_apart)
