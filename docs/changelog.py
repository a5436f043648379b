# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""CHANGELOG.md in the form that ROS releases read: `python docs/changelog.py > CHANGELOG.rst`, before a release.

CHANGELOG.md is the source, so CHANGELOG.rst is not kept in the repository. Versions become sections of a catkin
changelog, "Forthcoming" as long as a version has no date.
"""

import re
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]


def to_rst(text: str, package: str) -> str:
    """A changelog as reStructuredText.

    Parameters
    ----------
    text : str
        Markdown: `## VERSION (DATE or unreleased)`, and below it a list.
    package : str
        Name of the package.

    Returns
    -------
    str
        In the form of REP-132.
    """
    title = f"Changelog for package {package}"
    rule = "^" * len(title)
    lines = [rule, title, rule, ""]
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        heading, _, body = section.partition("\n")
        version, date = re.fullmatch(r"(\S+) \((.+)\)", heading.strip()).groups()
        name = "Forthcoming" if date == "unreleased" else f"{version} ({date})"
        lines += [name, "-" * len(name), _inline(body).strip(), ""]
    return "\n".join(lines)


def _inline(text: str) -> str:
    """Code, links and list marks."""
    text = re.sub(r"`([^`]+)`", r"``\1``", text)
    text = re.sub(r"\[([^\]]+)\]\(([^)]+)\)", r"`\1 <\2>`__", text)
    return re.sub(r"^- ", "* ", text, flags=re.MULTILINE)


if __name__ == "__main__":
    name = ElementTree.parse(ROOT / "package.xml").findtext("name")
    print(to_rst((ROOT / "CHANGELOG.md").read_text(), name), end="")
