# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Every callable of docs/reference/python.md says what goes in, what comes out and what it raises, by numpydoc.

A public docstring lists its parameters by name, all of them and in the order of the signature, each with a type and a
description; a class lists those of `__init__`, or its fields, as Parameters or as Attributes. What is returned is under
Returns, what a generator yields under Yields, and every error that the body raises under Raises. A property has a
sentence. Everything else of the project has a sentence as well.
"""

import ast
import builtins
import inspect
import re
from pathlib import Path

import pytest
from conftest import ROOT

import uncertain_lti
from uncertain_lti.base import errors

ERRORS = {n: kind for space in (errors, builtins) for n, kind in vars(space).items()
          if inspect.isclass(kind) and issubclass(kind, Exception)}  # fmt: skip


def documented() -> dict[str, set[str]]:
    """Names that the reference lists, with a dot after a class that it shows without members, by file."""
    found: dict[str, set[str]] = {}
    page = (ROOT / "docs/reference/python.md").read_text()
    for dotted, bare in re.findall(r"auto(?:function|class):: uncertain_lti\.(\S+)(\n   :no-members:)?", page):
        home = uncertain_lti._HOME.get(dotted)
        module, _, name = (dotted if home is None else f"{home}.{dotted}").rpartition(".")
        found.setdefault(f"core/{module.replace('.', '/')}.py", set()).add(name + "." * bool(bare))
    return found


def sections(docstring: str) -> dict[str, list[tuple[str, bool]]]:
    """Of each section its headings, and whether a description follows."""
    found: dict[str, list[tuple[str, bool]]] = {}
    lines = [*inspect.cleandoc(docstring).splitlines(), ""]
    current: list[tuple[str, bool]] = []
    for line, after in zip(lines, lines[1:], strict=False):
        if line and re.fullmatch("-{3,}", after):
            current = found[line] = []
        elif line.strip() and not line[0].isspace() and not re.fullmatch("-{3,}", line):
            current.append((line, after.startswith(" ")))
    return found


def own(node: ast.AST) -> list[ast.AST]:
    """What is in a node, without what is in functions and classes in it."""
    apart = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
    return [p for child in ast.iter_child_nodes(node) if not isinstance(child, apart) for p in (child, *own(child))]


def parameters(node: ast.FunctionDef | ast.ClassDef) -> list[str]:
    if isinstance(node, ast.ClassDef):
        for member in node.body:
            if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                return parameters(member)
        fields = [m for m in node.body if isinstance(m, ast.AnnAssign) and isinstance(m.target, ast.Name)]
        made = [ast.unparse(part) for part in (*node.decorator_list, *node.bases)]
        plain = any("dataclass" in text or text in ("NamedTuple", "TypedDict") for text in made)
        return [f.target.id for f in fields if plain and f.target.id[0] != "_" and "init=False" not in ast.unparse(f)]
    a = node.args
    every = [*a.posonlyargs, *a.args, *([a.vararg] if a.vararg else []), *a.kwonlyargs, *([a.kwarg] if a.kwarg else [])]
    return [arg.arg for arg in every if arg.arg not in ("self", "cls")]


def complaints(path: Path, listed: set[str] | None = None) -> list[str]:
    found = []
    for top in ast.parse(path.read_text()).body:
        whole = isinstance(top, ast.FunctionDef | ast.ClassDef) and (listed is None or top.name in listed)
        if whole or (isinstance(top, ast.ClassDef) and f"{top.name}." in (listed or ())):
            body = top.body if whole and isinstance(top, ast.ClassDef) else []
            members = [m for m in body if isinstance(m, ast.FunctionDef)]
            for node in (top, *(m for m in members if m.name[0].isalpha())):
                found += [f"{top.name}.{node.name}: {wrong}" for wrong in wanting(node)]
    return found


def wanting(node: ast.FunctionDef | ast.ClassDef) -> list[str]:
    said = sections(ast.get_docstring(node) or "")
    wrong = [f"{h} has no description" for t in ("Parameters", "Attributes", "Returns", "Raises")
             for h, described in said.get(t, []) if not described]  # fmt: skip
    heading = "Parameters" if "Parameters" in said else "Attributes" if isinstance(node, ast.ClassDef) else "Parameters"
    names = [n.strip().lstrip("*") for h, _ in said.get(heading, []) for n in h.split(" : ")[0].split(",")]
    if names != parameters(node):
        wrong.append(f"{heading} are {names}, the signature has {parameters(node)}")
    wrong += [f"{h} has no type" for h, _ in said.get(heading, []) if " : " not in h]
    if isinstance(node, ast.ClassDef):
        return wrong
    parts = own(node)
    raised = {ast.unparse(getattr(p.exc, "func", p.exc)).rpartition(".")[2] for p in parts
              if isinstance(p, ast.Raise) and p.exc}  # fmt: skip
    handlers = [ast.unparse(p.type) for p in parts if isinstance(p, ast.ExceptHandler) and p.type]
    caught = tuple(ERRORS[e] for text in handlers for e in re.findall(r"\w+", text) if e in ERRORS)
    lacking = {e for e in raised & ERRORS.keys() if not issubclass(ERRORS[e], caught)}
    lacking -= {e for h, _ in said.get("Raises", []) for e in h.split(", ")}
    wrong += [f"Raises lacks {error}" for error in sorted(lacking)]
    if not any("property" in ast.unparse(d) or ".setter" in ast.unparse(d) for d in node.decorator_list):
        yields = any(isinstance(p, (ast.Yield, ast.YieldFrom)) for p in parts)
        gives = any(isinstance(p, ast.Return) and p.value and ast.unparse(p.value) != "None" for p in parts)
        for title, there in (("Yields", yields), ("Returns", gives)):
            if there != (title in said):
                wrong.append(f"{title} is {'missing' if there else 'too much'}")
    return wrong


DOCUMENTED = documented()


@pytest.mark.parametrize("path", sorted(DOCUMENTED))
def test_docstrings_have_every_section(path: str) -> None:
    assert complaints(ROOT / path, DOCUMENTED[path]) == []


WRONG = {
    "def f(a, b):": "Parameters\n----------\na : int\n    One.",
    "def g(a):": "Parameters\n----------\na : int",
    "def h(a):": "Parameters\n----------\na\n    One.",
    "def i():\n    return 1": "",
    "def j():": "Returns\n-------\nint\n    One.",
    "def k():\n    raise ModelError": "",
}


@pytest.mark.parametrize("head", WRONG)
def test_each_way_to_be_incomplete_is_found(head: str, tmp_path: Path) -> None:
    first, _, rest = head.partition("\n")
    text = "".join(f"    {line}\n" for line in f'"""Do.\n\n{WRONG[head]}\n"""'.splitlines())
    (tmp_path / "wrong.py").write_text(f"{first}\n{text}{rest}\n")
    assert len(complaints(tmp_path / "wrong.py")) == 1
