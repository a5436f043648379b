# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Residuals: mean and covariance of how far healthy recordings lie from the centre of their bounds."""

from __future__ import annotations

import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.terms import checked, object_of

_KEYS = ("mean", "covariance")
_RELATIVE = "relative"
_LEAST = 1e-12
"""Share of the state's own variance below which what the others leave of it counts as none."""


class Residuals:
    """Mean and covariance of the utilisation (x_{k+1} - centre_k) / half_k over the transitions of the fit.

    Of a horizon those of the utilisation of its envelope, over the windows of the fit. If the spread of residuals
    changes with x, u and the regime as the half-widths do, one covariance describes the utilisation better; noise of
    the readings is the same everywhere, and then one of the residual itself, x_{k+1} - centre_k, normalised, does. The
    fit takes the likelier one.

    `mean` (n,): mean of each state; `covariance` (n, n): symmetric, with no negative eigenvalue but by rounding;
    `relative`: of the utilisation; False: of the residual itself.
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike, relative: bool = True) -> None:
        self.relative = relative
        self.mean = checked(mean, "residuals.mean", None)
        n = len(self.mean) if self.mean.ndim == 1 else 0
        if self.mean.ndim != 1 or n == 0:
            raise ModelError(f"residuals.mean has shape {self.mean.shape}; it must have one number per state")
        self.covariance = checked(covariance, "residuals.covariance", (n, n))
        size = float(np.abs(self.covariance).max())
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-9, atol=1e-12 * size):
            raise ModelError("residuals.covariance is not symmetric; fit the model again")
        least = float(np.linalg.eigvalsh(self.covariance / (size or 1.0)).min())
        if least < -1e-9 or (np.diagonal(self.covariance) < 0).any():
            raise ModelError("residuals.covariance has a negative variance; fit the model again")
        self.mean.flags.writeable = self.covariance.flags.writeable = False

    def __repr__(self) -> str:
        return f"Residuals({len(self.mean)} states)"

    def whitening(self, counted: ArrayLike) -> Array:
        """L^-1 of the counted states' covariance C = L Lᵀ: the sum of squares of L^-1 r is rᵀ C^-1 r.

        A state whose residual is exactly 0, or follows from those before it, adds nothing: its row is 0.

        `counted` (n,): states that count; Returns (n, n): lower triangular; rows and columns of states that do not
        count are 0.
        """
        n, C = len(self.mean), self.covariance
        inverse = np.zeros((n, n))
        done: list[int] = []
        for i in np.flatnonzero(np.asarray(counted, dtype=bool)).tolist():
            explained = inverse[done] @ C[:, i] if done else np.zeros(0)  # L row of i, by what came before
            left = float(C[i, i] - explained @ explained)
            if left <= _LEAST * float(C[i, i]):
                continue
            row = -(explained @ inverse[done]) if done else np.zeros(n)
            row[i] += 1.0
            inverse[i] = row / np.sqrt(left)
            done.append(i)
        return inverse

    def to_dict(self) -> dict[str, Any]:
        """The form of the model file."""
        found = {"mean": self.mean.tolist(), "covariance": self.covariance.tolist()}
        return found | ({_RELATIVE: True} if self.relative else {})

    @classmethod
    def from_dict(cls, data: Any, name: str = "residuals") -> Residuals:
        """From a model file."""
        data = object_of(data, name, known=(*_KEYS, _RELATIVE), needed=_KEYS)
        relative = data.get(_RELATIVE, False)
        if not isinstance(relative, bool):
            raise ModelError(f"field '{name}.{_RELATIVE}' is {reprlib.repr(relative)}; it must be true or false")
        return cls(data["mean"], data["covariance"], relative)
