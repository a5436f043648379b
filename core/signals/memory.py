# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Memory: what a signal takes from earlier samples of a field, as in lag(field, 2), diff(field) and rate(field)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from uncertain_lti.base.errors import SignalError

LONGEST_DELAY = 1_000_000
"""Samples by which a signal is taken earlier at most."""

KINDS: tuple[Literal["lag", "diff", "rate"], ...] = ("lag", "diff", "rate")
"""Functions of a field's earlier samples."""

_NUMBERED = re.compile(r"(.*?),\s*([+-]?\d+)\s*", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Memory:
    """How a signal follows from the samples of its field, up to the present one.

    Sample k takes y_{k - samples} (lag), y_k - y_{k-1} (diff) or (y_k - y_{k-1}) / Δt_{k-1} (rate); there is none until
    the segment has the samples that it needs.

    `kind`: the function; `samples`: samples by which a lag is earlier.
    """

    kind: Literal["lag", "diff", "rate"]
    samples: int = 1

    def of(self, field: str) -> str:
        """The field path of this memory of a field."""
        return f"lag({field}, {self.samples})" if self.kind == "lag" else f"{self.kind}({field})"


@lru_cache(maxsize=4096)
def parse_memory(text: str) -> tuple[Memory | None, str]:
    """Take the function of earlier samples off a field path."""
    match = re.fullmatch(rf"\s*({'|'.join(KINDS)})\s*\((.*)\)\s*", text, re.DOTALL)
    if not match:
        return None, text.strip()
    kind = next(k for k in KINDS if k == match[1])
    inner, samples = match[2].strip(), 1
    if numbered := _NUMBERED.fullmatch(inner):
        if kind != "lag":
            raise SignalError(f"field '{text}': {kind} takes a field alone; write {kind}({numbered[1].strip()})")
        inner, samples = numbered[1].strip(), int(numbered[2])
        if not 1 <= samples <= LONGEST_DELAY:
            raise SignalError(f"field '{text}': a lag is 1 to {LONGEST_DELAY} samples, not {samples}")
    if re.match(rf"({'|'.join(KINDS)})\s*\(", inner):
        raise SignalError(f"field '{text}': {', '.join(KINDS)} do not nest; write one of them")
    return Memory(kind, samples), inner
