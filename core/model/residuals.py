# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Residuals: mean and covariance of what the centre of the bounds leaves unexplained of healthy recordings."""

from __future__ import annotations

import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.terms import checked

_KEYS = ("mean", "covariance")
_LEAST = 1e-12
"""Share of the state's own variance below which what the others leave of it counts as none."""


class Residuals:
    """Mean and covariance of r_k = x_{k+1} - centre_k over the transitions of the fit, normalised.

    Of a horizon those of x_{k+h} less the centre of its envelope, over the windows of the fit.

    Parameters
    ----------
    mean : array (n,)
        Mean of each state.
    covariance : array (n, n)
        Symmetric, with no negative eigenvalue but by rounding.

    Raises
    ------
    ModelError
        The shapes do not fit, a number is not finite, or the covariance is none.
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike) -> None:
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

        Parameters
        ----------
        counted : array of bool (n,)
            States that count.

        Returns
        -------
        array (n, n)
            Lower triangular; rows and columns of states that do not count are 0.
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
        """The form of the model file.

        Returns
        -------
        dict
            Plain data.
        """
        return {"mean": self.mean.tolist(), "covariance": self.covariance.tolist()}

    @classmethod
    def from_dict(cls, data: Any, name: str = "residuals") -> Residuals:
        """From a model file.

        Parameters
        ----------
        data : Any
            What `to_dict` gives.
        name : str
            Field, for errors.

        Returns
        -------
        Residuals
            As listed.

        Raises
        ------
        ModelError
            It is not that; names the field.
        """
        if not isinstance(data, dict):
            raise ModelError(f"field '{name}' is not an object")
        for key in data:
            if key not in _KEYS:
                raise ModelError(f"unknown field '{name}.{reprlib.repr(key)[1:-1]}'; known are {', '.join(_KEYS)}")
        for key in _KEYS:
            if key not in data:
                raise ModelError(f"field '{name}.{key}' is missing; fit the model again")
        return cls(**data)
