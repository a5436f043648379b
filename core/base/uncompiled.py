# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `import cython` gives where Cython is absent: decorators and types that do nothing.

Modules of the live chain are typed Python: they run as they are, and are compiled where a compiler is there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

_T = TypeVar("_T")

compiled = False


def _same(thing: _T) -> _T:
    return thing


def _decorator(*_: Any, **__: Any) -> Callable[[_T], _T]:
    return _same


cclass = ccall = cfunc = inline = final = _same
locals = returns = exceptval = boundscheck = wraparound = cdivision = initializedcheck = freelist = _decorator


def declare(type: Any = None, value: Any = None, **_: Any) -> Any:
    """Declare a variable or an attribute."""
    return value


class _Type:
    def __getitem__(self, _: Any) -> _Type:
        return self


double = longlong = int = bint = uchar = char = Py_ssize_t = p_double = p_longlong = p_uchar = _Type()
