# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Every public callable says what goes in, what comes out and what it raises, in numpydoc sections.

The rule. A callable is public when docs/reference/python.md lists it or its class, and its name begins with a letter.
Everything else has a sentence, with the shapes and units that are not plain from the code. A public docstring lists its
parameters by name, all of them and in the order of the signature, each with a type and a description; a class lists
those of `__init__`, or its fields, as Parameters or as Attributes. What is returned is under Returns, what a generator
or a context manager yields under Yields, and every error that the body raises, itself or through a private helper of
the same module, under Raises. Excepted are:

- properties, which a sentence describes, from Returns;
- methods of the language's own protocols (`__iter__`, `__eq__`, ...);
- errors with a private name, which do not leave their module, and those that the body catches;
- members of an Enum and errors, which take no parameters of their own.
"""

import ast
import builtins
import inspect
import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import uncertain_lti
from uncertain_lti.base import errors

ROOT = Path(__file__).resolve().parents[1]
Function = ast.FunctionDef | ast.AsyncFunctionDef
PROJECT_ERRORS = {name for name, kind in vars(errors).items() if inspect.isclass(kind)}
LANGUAGE_ERRORS = {
    name for name, kind in vars(builtins).items() if inspect.isclass(kind) and issubclass(kind, Exception)
}
FIELDS = ("NamedTuple", "TypedDict")
GUARDED = {"likely_groups": {"FitError"}}  # asks its helper for the folders of paths that are there, and of no others
"""Errors of a helper that cannot leave a callable, which a look at the calls alone does not tell."""


@dataclass
class Section:
    """Entries of one section: heading of each, and whether a description follows."""

    headings: list[str] = field(default_factory=list)
    described: list[bool] = field(default_factory=list)

    def names(self) -> list[str]:
        return [name.strip().lstrip("*") for text in self.headings for name in text.split(" : ")[0].split(",")]


def sections(docstring: str) -> dict[str, Section]:
    found: dict[str, Section] = {}
    lines = inspect.cleandoc(docstring).splitlines()
    current = Section()
    for number, line in enumerate(lines):
        if number + 1 < len(lines) and line and re.fullmatch("-{3,}", lines[number + 1]):
            assert len(lines[number + 1]) == len(line), f"the line under '{line}' is not as long as it"
            current = found[line] = Section()
        elif re.fullmatch("-{3,}", line) or not line.strip():
            continue
        elif not line[0].isspace():
            current.headings.append(line)
            current.described.append(False)
        elif current.described:
            current.described[-1] = True
    return found


def decorators(node: Function | ast.ClassDef) -> str:
    return " ".join(ast.unparse(d) for d in node.decorator_list)


def is_property(node: Function) -> bool:
    return re.search(r"property|\.setter", decorators(node)) is not None


def signature(node: Function) -> dict[str, str | None]:
    """Name -> default value, as written."""
    a = node.args
    plain = [*a.posonlyargs, *a.args]
    names: dict[str, str | None] = dict.fromkeys(arg.arg for arg in plain)
    for arg, value in zip(reversed(plain), reversed(a.defaults), strict=False):
        names[arg.arg] = ast.unparse(value)
    if a.vararg:
        names[a.vararg.arg] = None
    for arg, default in zip(a.kwonlyargs, a.kw_defaults, strict=True):
        names[arg.arg] = default and ast.unparse(default)
    if a.kwarg:
        names[a.kwarg.arg] = None
    return {name: default for name, default in names.items() if name not in ("self", "cls")}


def parameters(node: Function | ast.ClassDef) -> dict[str, str | None]:
    if not isinstance(node, ast.ClassDef):
        return signature(node)
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return signature(member)
    if "dataclass" not in decorators(node) and not any(ast.unparse(base) in FIELDS for base in node.bases):
        return {}
    return {
        member.target.id: member.value and ast.unparse(member.value)
        for member in node.body
        if isinstance(member, ast.AnnAssign)
        and isinstance(member.target, ast.Name)
        and not member.target.id.startswith("_")
        and "ClassVar" not in ast.unparse(member.annotation)
        and "init=False" not in ast.unparse(member.value or ast.Constant(0))
    }


def own(node: ast.AST) -> list[ast.AST]:
    """A node and what is in it, without what is in functions and classes in it."""
    found = [node]
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)):
            found += own(child)
    return found


def yields(node: Function) -> bool:
    return any(isinstance(part, (ast.Yield, ast.YieldFrom)) for part in own(node))


def returns(node: Function) -> bool:
    return any(isinstance(p, ast.Return) and p.value and ast.unparse(p.value) != "None" for p in own(node)) or (
        node.returns is not None and ast.unparse(node.returns) not in ("None", "NoReturn") and not yields(node)
    )


class Module:
    """Functions and classes of one file by name, and what each raises."""

    def __init__(self, path: Path, listed: set[str] | None = None) -> None:
        self.path, self.listed = path, listed
        self.functions: dict[str, Function] = {}
        self.classes: dict[str, ast.ClassDef] = {}
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                self.functions[node.name] = node
            elif isinstance(node, ast.ClassDef):
                self.classes[node.name] = node
                for member in node.body:
                    if isinstance(member, (ast.FunctionDef, ast.AsyncFunctionDef)):
                        self.functions[f"{node.name}.{member.name}"] = member

    def public(self) -> dict[str, Function | ast.ClassDef]:
        every: dict[str, Function | ast.ClassDef] = {**self.classes, **self.functions}
        names = [name for name in every if all(part[0].isalpha() for part in name.split("."))]
        return {name: every[name] for name in names if self.listed is None or name.split(".")[0] in self.listed}

    def raised(self, name: str, seen: frozenset[str] = frozenset()) -> set[str]:
        """Errors that leave a function, by itself and by the private helpers that it calls."""
        if name in seen or name not in self.functions:
            return set()
        return self._leaving(self.functions[name], name.rpartition(".")[0], seen | {name})

    def _leaving(self, node: ast.AST, of_class: str, seen: frozenset[str]) -> set[str]:
        found: set[str] = set()
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)):
                continue
            if isinstance(child, ast.Try):
                caught = {
                    n for h in child.handlers for n in re.findall(r"\w+", ast.unparse(h.type or ast.Name("Exception")))
                }
                inner = {e for part in child.body for e in self._leaving(ast.Module([part], []), of_class, seen)}
                found |= {e for e in inner if not _catches(caught, e)}
                for part in [*child.handlers, *child.orelse, *child.finalbody]:
                    found |= self._leaving(part, of_class, seen)
                continue
            if isinstance(child, ast.Raise) and child.exc is not None:
                kind = child.exc.func if isinstance(child.exc, ast.Call) else child.exc
                kind_name = ast.unparse(kind).rpartition(".")[2]
                if kind_name in PROJECT_ERRORS | LANGUAGE_ERRORS:
                    found.add(kind_name)
            if isinstance(child, ast.Call):
                called = ast.unparse(child.func)
                if called.startswith("_"):
                    found |= self.raised(called, seen)
                elif called.startswith("self._"):
                    found |= self.raised(f"{of_class}.{called.removeprefix('self.')}", seen)
            found |= self._leaving(child, of_class, seen)
        return found


def _catches(caught: set[str], error: str) -> bool:
    known = {**vars(builtins), **vars(errors)}
    return any(name in known and issubclass(known[error], known[name]) for name in caught & known.keys())


def complaints(module: Module) -> list[str]:
    found = []
    for name, node in module.public().items():
        text = ast.get_docstring(node) or ""
        try:
            found += [f"{name}: {what}" for what in _wanting(module, name, node, sections(text))]
        except AssertionError as wrong:
            found.append(f"{name}: {wrong}")
    return found


def _wanting(module: Module, name: str, node: Function | ast.ClassDef, said: dict[str, Section]) -> list[str]:
    wanting = []
    is_class = isinstance(node, ast.ClassDef)
    heading = "Attributes" if is_class and "Attributes" in said and "Parameters" not in said else "Parameters"
    listed, wanted = said.get(heading, Section()), parameters(node)
    if listed.names() != list(wanted):
        wanting.append(f"{heading} are {listed.names()}, the signature has {list(wanted)}")
    for text in listed.headings:
        names, _, kind = text.partition(" : ")
        if not kind:
            wanting.append(f"'{names}' has no type")
        if default := re.search(r"default (.*)$", kind):
            actual = {wanted.get(one.strip()) for one in names.split(",")}
            if {str(value).replace("'", '"') for value in actual} != {default[1]}:
                wanting.append(f"'{names}' has not the default {default[1]}")
    for title, section in said.items():
        if title in ("Parameters", "Attributes", "Returns", "Yields", "Raises"):
            wanting += [
                f"{title}: '{h}' says nothing"
                for h, d in zip(section.headings, section.described, strict=True)
                if not d
            ]
    if is_class:
        raised = module.raised(f"{name}.__init__") | module.raised(f"{name}.__post_init__")
    else:
        raised = module.raised(name)
        if not is_property(node):
            if yields(node) != ("Yields" in said):
                wanting.append("Yields is missing" if yields(node) else "yields nothing, and has Yields")
            if returns(node) != ("Returns" in said):
                wanting.append("Returns is missing" if returns(node) else "returns nothing, and has Returns")
    unsaid = raised - set(said.get("Raises", Section()).names()) - GUARDED.get(name, set())
    if unsaid:
        wanting.append(f"Raises lacks {', '.join(sorted(unsaid))}")
    return wanting


def documented() -> dict[str, set[str]]:
    """Names that the reference lists, by the file that defines them."""
    found: dict[str, set[str]] = {}
    page = (ROOT / "docs/reference/python.md").read_text()
    for dotted in re.findall(r"auto(?:function|class):: uncertain_lti\.(\S+)", page):
        home = uncertain_lti._HOME.get(dotted)
        module, _, name = (dotted if home is None else f"{home}.{dotted}").rpartition(".")
        found.setdefault(f"core/{module.replace('.', '/')}.py", set()).add(name)
    return found


DOCUMENTED = documented()


@pytest.mark.parametrize("path", sorted(DOCUMENTED))
def test_docstrings_have_every_section(path: str) -> None:
    module = Module(ROOT / path, DOCUMENTED[path])
    assert module.public().keys() >= DOCUMENTED[path]
    assert complaints(module) == []


WRONG = '''
class FitError(Exception):
    pass

def unlisted(a, b):
    """Do.

    Parameters
    ----------
    a : int
        One.
    """

def too_many(a):
    """Do.

    Parameters
    ----------
    a : int
        One.
    b : int
        Two.
    """

def silent_return() -> int:
    """Give one."""
    return 1

def returns_nothing() -> None:
    """Do.

    Returns
    -------
    int
        One.
    """

def _helper():
    raise FitError

def unsaid():
    """Do."""
    _helper()

def wrong_default(a=3):
    """Do.

    Parameters
    ----------
    a : int, default 4
        One.
    """

def undescribed(a):
    """Do.

    Parameters
    ----------
    a : int
    """
'''


def test_each_way_to_be_incomplete_is_found(tmp_path: Path) -> None:
    file = tmp_path / "wrong.py"
    file.write_text(WRONG)
    found = {complaint.split(":")[0] for complaint in complaints(Module(file))}
    assert found == set(Module(file).public()) - {"FitError"}


CAUGHT = '''
def reads():
    """Do."""
    try:
        raise FileNotFoundError
    except OSError:
        pass
'''


def test_an_error_that_the_body_catches_is_not_asked_for(tmp_path: Path) -> None:
    file = tmp_path / "caught.py"
    file.write_text(CAUGHT)
    assert complaints(Module(file)) == []
