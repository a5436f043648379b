# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""YAML without its traps: no aliases, and numbers only as everybody writes them."""

from __future__ import annotations

import re
from typing import Any, TextIO

_ODD = re.compile(r"[-+]?0[0-7_]+|.*[:_].*")  # octal, sexagesimal, with underscores


def compose(text: str | TextIO) -> Any:
    """Nodes of a text; `010` and `1:30`, which YAML 1.1 takes for 8 and 90, stay the words they are."""
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
