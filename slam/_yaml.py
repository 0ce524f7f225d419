"""YAML that people write by hand: rigs and configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from slam.errors import LogError

#: Values that one file may come to when every alias is written out: arrays are made of them, so that a few lines of
#: aliases of aliases would be more than there is memory.
_MOST_VALUES = 100_000


def read_yaml(path: Path) -> Any:
    """What a file says.

    Raises:
        LogError: it cannot be read, is no YAML of plain values, or comes to too many of them.
    """
    try:
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        node = loader.get_single_node()
        if node is None:
            return None
        if _values_of(node, {}) > _MOST_VALUES:
            raise LogError(path, f"expected at most {_MOST_VALUES} values, got more by its aliases")
        return loader.construct_document(node)
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
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


def _values_of(node: Any, known: dict[int, int]) -> int:
    """Values that a node comes to; one that holds itself comes to too many."""
    found = known.get(id(node))
    if found is not None:
        return found
    known[id(node)] = _MOST_VALUES + 1  # until all that is in it is counted
    count = 1
    if isinstance(node, yaml.SequenceNode):
        count += sum(_values_of(one, known) for one in node.value)
    elif isinstance(node, yaml.MappingNode):
        count += sum(_values_of(one, known) for pair in node.value for one in pair)
    known[id(node)] = count
    return count
