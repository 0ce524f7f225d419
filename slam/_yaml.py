"""YAML that people write by hand, rigs and configurations, and what the models of it have in common."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Self, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slam.errors import LogError, cannot_be_read

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

#: Values that one file may come to when every alias is written out: arrays are made of them, so that a few lines of
#: aliases of aliases would be more than there is memory.
_MOST_VALUES = 100_000


class Frozen(BaseModel):
    """What all parts of a file are: unchangeable, and strict about the keys they know."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)

    @classmethod
    def from_yaml(cls, path: Path | str) -> Self:
        """Read a file; anything wrong is a `LogError` whose one sentence names the file and the key."""
        path = Path(path)
        data = _plain_values(path)
        if not isinstance(data, dict | None):
            raise LogError(path, f"expected a mapping of keys to values, got {type(data).__name__}")
        try:
            return cls.model_validate(data or {})
        except ValidationError as error:
            raise LogError(path, _first_problem(cls, error)) from error


def _plain_values(path: Path) -> Any:
    """What a file says; LogError: it cannot be read, is no YAML of plain values, or comes to too many of them."""
    try:
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        node = loader.get_single_node()
        if node is None:
            return None
        if _values_of(node, {}) > _MOST_VALUES:
            raise LogError(path, f"expected at most {_MOST_VALUES} values, got more by its aliases")
        return loader.construct_document(node)
    except OSError as error:
        raise cannot_be_read(path, error) from error
    except UnicodeDecodeError as error:
        raise LogError(path, "expected text in UTF-8, got other bytes") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise LogError(path, "expected YAML, got a syntax error", line=mark.line + 1 if mark else None) from error
    except LogError:
        raise
    except (ValueError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError) as error:
        # the constructors of `!!int ''`, `!!bool x` or `!!timestamp x` fail in as many ways
        raise LogError(path, "expected YAML, got a value that is not what its tag says, or too deep") from error


def _first_problem(model: type[BaseModel], error: ValidationError) -> str:
    """One sentence on the first thing pydantic found wrong, naming the key."""
    first = error.errors()[0]
    key = f"{'.'.join(map(str, first['loc'])):.100}"
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{key}: unknown key{_near_key(model, first['loc'])}"
    if first["type"] == "missing":
        return f"{key}: missing"
    message = first["msg"].removeprefix("Value error, ")
    return f"{key}: {message[0].lower()}{message[1:]}, got {reprlib.repr(first['input']):.60}"


def _near_key(model: Any, place: Sequence[int | str]) -> str:
    """What to say of an unknown key at a place in a file of a model: the known key that is nearest, if one is near."""
    for part in place[:-1]:
        known = _keys_of(model)
        model = known.get(str(part)) if known else next(iter(get_args(model)[1:]), None)
    found = get_close_matches(str(place[-1]), _keys_of(model), n=1)
    return f", did you mean {found[0]}?" if found else ""


def _keys_of(model: Any) -> dict[str, Any]:
    """Keys of a pydantic model or a dataclass with the types of their values; none of anything else."""
    if is_dataclass(model):
        return {field.name: field.type for field in fields(model)}
    return {name: one.annotation for name, one in getattr(model, "model_fields", {}).items()}


def _values_of(node: Any, known: dict[int, int]) -> int:
    """Values that a node comes to; one that holds itself comes to too many."""
    if id(node) not in known:
        known[id(node)] = _MOST_VALUES + 1  # until all that is in it is counted
        inside = node.value if isinstance(node, yaml.CollectionNode) else ()
        ones = chain.from_iterable(inside) if isinstance(node, yaml.MappingNode) else inside
        known[id(node)] = 1 + sum(_values_of(one, known) for one in ones)
    return known[id(node)]
