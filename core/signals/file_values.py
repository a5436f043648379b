# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Values in a YAML file, read without its traps and checked, with errors that name them."""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Callable
from typing import Any, TextIO, TypeVar

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.files import kind_of
from uncertain_lti.base.text import meant

T = TypeVar("T")
_ODD = re.compile(r"[-+]?0[0-7_]+|.*[:_].*")  # octal, sexagesimal, with underscores


def compose(text: str | TextIO) -> Any:
    """Nodes of a text; aliases are refused, and `010` and `1:30`, 8 and 90 by YAML 1.1, stay the words they are."""
    import yaml  # the live node reads signals from the model file and needs no YAML

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
                raise yaml.composer.ComposerError(None, None, "an alias (*name); write out what it stands for", mark)
            node: Any = super().compose_node(parent, index)
            if str(node.tag).endswith((":int", ":float")) and _ODD.fullmatch(node.value):
                node.tag = "tag:yaml.org,2002:str"
            return node

    return yaml.compose(text, Loader=Loader)


def construct(node: Any) -> Any:
    """What nodes of `compose` stand for."""
    import yaml

    return yaml.SafeLoader("").construct_document(node) if node else None


def load_yaml(path: str | os.PathLike[str]) -> Any:
    """Read the structure of a signals file."""
    import yaml  # the live node reads signals from the model file and needs no YAML

    if (kind := kind_of(path)) and kind != "a signals file":
        raise SignalError(f"{path}: this is {kind}, and a signals file is wanted here; {_remedy(kind)}")
    try:
        with open(path, encoding="utf-8") as stream:
            node = compose(stream)
        if repeated := _repeated_key(node):
            raise SignalError(
                f"{path}: key '{repeated.value}' is twice in one mapping, again at line "
                f"{repeated.start_mark.line + 1}; keep one"
            )
        data = construct(node)
    except FileNotFoundError:
        raise SignalError(f"{path}: there is no such signals file; check the path") from None
    except OSError as error:
        raise SignalError(f"{path}: cannot be read: {error.strerror}; check the path") from None
    except UnicodeDecodeError as error:
        raise SignalError(f"{path}: is not UTF-8 at byte {error.start + 1}; save it as UTF-8 text") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date 2001-99-99
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or error).splitlines()[0]
        raise SignalError(f"{path}: is not YAML{line}: {problem}; mend it") from None
    if data is None:
        raise SignalError(
            f"{path}: nothing is in it; list the states and controls, or let `uncertain-lti init` propose them"
        )
    return data


def _repeated_key(top: Any) -> Any:
    """The first key node that is twice in its mapping, of which YAML readers keep the last; None without any."""
    waiting, seen = [top], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen or not isinstance(getattr(node, "value", None), list):
            continue  # an alias, or a scalar
        seen.add(id(node))
        keys = set()
        for entry in node.value:
            if not isinstance(entry, tuple):
                waiting.append(entry)
                continue
            key, value = entry
            waiting += [key, value]
            if isinstance(key.value, str):
                if key.value in keys:
                    return key
                keys.add(key.value)
    return None


def checked_mapping(data: Any, where: str, known: set[str] | None) -> dict[str, Any]:
    """Check that a value is a mapping with known keys."""
    if not isinstance(data, dict):
        raise SignalError(f"{where}: a mapping is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    for key in data:
        if known is not None and key not in known:
            raise SignalError(
                f"{where}: unknown key {reprlib.repr(key)}{meant(key, known)}; known are {', '.join(sorted(known))}"
            )
    return data


def kind_in_yaml(data: object) -> str:
    """Name what a value is in the words of YAML."""
    names = {dict: "a mapping", list: "a list", str: "a text", bool: "a truth value", type(None): "nothing"}
    return names.get(type(data), "a number" if isinstance(data, (int, float)) else type(data).__name__)


def _remedy(kind: str) -> str:
    """What to do about a file of another kind."""
    return "name a file in it" if kind == "a folder" else "are the arguments swapped?"


def wrong(where: str, value: object, write: str) -> SignalError:
    """The error for a value that cannot stand where it does."""
    return SignalError(f"{where} is {reprlib.repr(value)}; write {write}")


def checked_number(value: Any, where: str) -> float:
    """Check that a value is a number."""
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (str, int, float)) else float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if math.isnan(number):
        raise wrong(where, value, "a number")
    return number


def checked_numbers(values: Any, where: str) -> tuple[float, ...]:
    """Check that a value is a list of numbers."""
    if not isinstance(values, (list, tuple)) or not values:
        raise wrong(where, values, "a list of numbers")
    return tuple(checked_number(value, f"{where}[{i}]") for i, value in enumerate(values))


def checked_list(data: Any, where: str, entry: Callable[[Any, str], T]) -> tuple[T, ...]:
    """Check that a value is a list, of entries that `entry` takes with their places."""
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    return tuple(entry(one, f"{where}[{i}]") for i, one in enumerate(data))
