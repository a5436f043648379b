# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Sphinx settings; `./run docs` builds the pages, and a warning is an error."""

import re
import sys
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "tests" / "checkout")]

import generate  # noqa: E402  (beside this file)

from uncertain_lti import __version__  # noqa: E402

project = "uncertain_lti_ros"
author = "the uncertain_lti_ros maintainers"
copyright = "the uncertain_lti_ros maintainers, Apache-2.0"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "reference/*.generated.md"]
default_role = "code"
smartquotes = False  # --json is no dash

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and units
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["math.css"]
html_title = "uncertain_lti_ros"
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False


def _mathml(block: bool):
    def visit(translator, node):
        formula = node.astext()
        number = None
        if tag := re.search(r"\\tag\{([^}]*)\}", formula):  # which the converter sets right behind the formula
            formula, number = formula.replace(tag[0], ""), tag[1]
        text = convert(formula, display="block" if block else "inline")
        label = f'<span class="eqno">({number})</span>' if number else ""
        translator.body.append(f"<div class='math'>{text}{label}</div>" if block else text)
        raise nodes.SkipNode

    return visit


def _plain(app, what, name, obj, options, lines):
    """Docstrings are plain text with formulas: |x| is no substitution, and a trailing underscore no link."""
    lines[:] = [line.replace("|", "\\|") for line in lines]


def setup(app):
    """Formulas as MathML, which browsers draw without any script, and the generated parts of the reference."""
    app.add_html_math_renderer("mathml", (_mathml(False), None), (_mathml(True), None))
    app.connect("autodoc-process-docstring", _plain)
    generate.write(HERE / "reference")
