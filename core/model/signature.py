# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Signature: what labelled faulty recordings leave in the utilisation over states and horizons."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.model.terms import checked, is_whole, object_of

MOST_SIGNATURES = 256
_KEYS = ("label", "recordings", "verdicts", "steps", "moments")


class Signature:
    """One kind of fault.

    Parameters
    ----------
    label : str
        What it is called.
    steps : sequence of int (H,)
        Horizons, rising; 1 for one step.
    moments : array (H, n, n)
        Of each horizon the mean of u uᵀ, u the utilisations of the states while the alarm was on, scaled to the
        Frobenius norm 1; 0 for a horizon without a verdict.
    recordings : int, default 1
        Recordings that it was learnt from.
    verdicts : int, default 0
        Verdicts of them.

    Raises
    ------
    ModelError
        The label is empty, or the arrays do not fit.
    """

    def __init__(
        self, label: str, steps: Sequence[int], moments: ArrayLike, recordings: int = 1, verdicts: int = 0
    ) -> None:
        if not isinstance(label, str) or not label.strip() or any(c in label for c in "=\n\r"):
            raise ModelError(f"signatures: the label {reprlib.repr(label)} must be a text without = and line breaks")
        self.label = label
        self.steps = tuple(steps)
        name = f"signatures[{label}]"
        whole = all(map(is_whole, (*self.steps, recordings, verdicts)))
        if not (whole and self.steps and self.steps[0] >= 1 and recordings >= 1 and verdicts >= 0):
            raise ModelError(f"field '{name}' must have whole numbers as steps, recordings and verdicts")
        if any(b <= a for a, b in zip(self.steps, self.steps[1:], strict=False)):
            raise ModelError(f"field '{name}.steps' must rise")
        self.moments = checked(moments, f"{name}.moments", None)
        if self.moments.ndim != 3 or len(self.moments) != len(self.steps) or len(set(self.moments.shape[1:])) != 1:
            raise ModelError(f"field '{name}.moments' must have one square matrix per horizon")
        self.moments.flags.writeable = False
        self.recordings, self.verdicts = recordings, verdicts

    def __repr__(self) -> str:
        return f"Signature({self.label!r} of {plural(self.recordings, 'recording')})"

    def to_dict(self) -> dict[str, Any]:
        """As it is in a model file."""
        found = {name: getattr(self, name) for name in _KEYS}
        return found | {"steps": list(self.steps), "moments": self.moments.tolist()}

    @classmethod
    def list_from(cls, data: Any) -> tuple[Signature, ...]:
        """From a model file."""
        if not isinstance(data, list):
            raise ModelError("field 'signatures' must be a list of objects")
        for i, entry in enumerate(data):
            if not isinstance(object_of(entry, f"signatures[{i}]", _KEYS, _KEYS)["steps"], list):
                raise ModelError(f"field 'signatures[{i}].steps' must be a list")
        return tuple(cls(**entry) for entry in data)


def checked_signatures(signatures: Sequence[Signature], n: int) -> tuple[Signature, ...]:
    """The signatures of one model."""
    labels = [signature.label for signature in signatures]
    if len(set(labels)) < len(labels) or len(labels) > MOST_SIGNATURES:
        raise ModelError(f"field 'signatures' must have different labels, at most {MOST_SIGNATURES}")
    for signature in signatures:
        if signature.moments.shape[1] != n:
            raise ModelError(f"signature '{signature.label}' is not one of {plural(n, 'state')}")
    return tuple(signatures)


def closeness(a: Signature, b: Signature) -> float:
    """How alike two signatures are."""
    other = dict(zip(b.steps, b.moments, strict=True))
    pairs = [(own, other[h]) for h, own in zip(a.steps, a.moments, strict=True) if h in other]
    common = [(p, q) for p, q in pairs if p.any() and q.any()]
    cosines = [float(np.sum(p * q) / np.sqrt(np.sum(p * p) * np.sum(q * q))) for p, q in common]
    return sum(cosines) / len(cosines) if cosines else 0.0
