# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What is refused is refused in one sentence."""

from collections.abc import Callable
from typing import Any

import pytest


def refuses(error: Any, words: str, call: Callable[..., Any], /, *arguments: Any, **options: Any) -> str:
    """The sentence with which a call is refused; error: its class, or several; words: a regular expression for it."""
    with pytest.raises(error, match=words) as caught:
        call(*arguments, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence
    return sentence
