"""Structure: what is known of single elements before the fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.terms import ADDITIVE, HALF_WIDTHS, TERMS


class Structure:
    """Elements fixed to values, or kept within bounds.

    Parameters
    ----------
    n : int
        Number of states.
    m : int
        Number of controls.
    fixed : mapping, optional
        From "A", "B", "c", "dA", "dB", "dc" or "v" to an array of that shape: a number fixes the element, NaN leaves
        it free.
    lower : mapping of str to ArrayLike, optional
        Lower bounds by the same names; NaN for none. A sign constraint is a bound of 0. Half-widths are never below 0.
    upper : mapping of str to ArrayLike, optional
        Upper bounds likewise.

    Raises
    ------
    FitError
        A name or shape is unknown, or an element is bounded to nothing; names the element.
    """

    def __init__(
        self,
        n: int,
        m: int,
        fixed: Mapping[str, ArrayLike] | None = None,
        lower: Mapping[str, ArrayLike] | None = None,
        upper: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        self.n, self.m = n, m
        nominal = [term for term in TERMS if term.nominal]
        self._shapes = {term.nominal: term.shape(n, m) for term in nominal}
        self._shapes |= {term.half: term.shape(n, m) for term in TERMS}
        self.lower: dict[str, Array] = {}
        self.upper: dict[str, Array] = {}
        for name, shape in self._shapes.items():
            self.lower[name] = np.full(shape, 0.0 if name in HALF_WIDTHS else -math.inf)
            self.upper[name] = np.full(shape, math.inf)
        for given, targets in (
            (lower, (self.lower,)),
            (upper, (self.upper,)),
            (fixed, (self.lower, self.upper)),
        ):
            for name, values in (given or {}).items():
                for target in targets:
                    said = self._read(name, values)
                    target[name] = np.where(np.isnan(said), target[name], said)
        for name in self._shapes:
            wrong = np.argwhere(self.lower[name] > self.upper[name])
            if len(wrong):
                at = tuple(wrong[0].tolist())
                raise FitError(
                    f"structure: {name}{list(at)} is to be at least {self.lower[name][at]:g} and at most "
                    f"{self.upper[name][at]:g}; mend one of them"
                )
            if name in HALF_WIDTHS and (self.lower[name] < 0).any():
                at = tuple(np.argwhere(self.lower[name] < 0)[0].tolist())
                raise FitError(f"structure: {name}{list(at)} is a half-width and cannot be below 0")

    def _read(self, name: str, values: ArrayLike) -> Array:
        if name not in self._shapes:
            raise FitError(f"structure: there is no '{name}'; there are {', '.join(self._shapes)}")
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise FitError(f"structure: {name} is not an array of numbers; write NaN for a free element") from None
        if array.shape != self._shapes[name]:
            raise FitError(f"structure: {name} has shape {array.shape}; it must be {self._shapes[name]}")
        return array

    @classmethod
    def from_rules(
        cls, rules: Any, states: Sequence[str], controls: Sequence[str], source: str = "structure"
    ) -> Structure:
        """From the list under `structure:` in a signals file.

        Each rule names elements by `state` (the row; `*` for all) and `from` (a state, a control, `drift`, `noise` or
        `*` for every state and control), and says `nominal` and/or `half_width`: a number, or {min: a, max: b}.
        A later rule overrides an earlier one.

        Parameters
        ----------
        rules : object
            The list.
        states : sequence of str
            Names.
        controls : sequence of str
            Names.
        source : str, default "structure"
            What errors call the list.

        Returns
        -------
        Structure
            The structure.

        Raises
        ------
        FitError
            A rule names what is not there, or is not of this form.
        """
        n, m = len(states), len(controls)
        structure = cls(n, m)
        if not isinstance(rules, list):
            raise FitError(f"{source}: a list of rules is wanted, not {type(rules).__name__}")
        for number, rule in enumerate(rules):
            here = f"{source}[{number}]"
            if not isinstance(rule, dict) or not {"state", "from"} <= set(rule) <= {
                "state",
                "from",
                "nominal",
                "half_width",
            }:
                raise FitError(f"{here}: a rule has the keys state, from, and nominal and/or half_width")
            rows = range(n) if rule["state"] == "*" else [_position(rule["state"], states, f"{here}: state")]
            columns: list[tuple[str, str, int | None]] = []
            additive = [term for term in ADDITIVE if rule["from"] == term.word]
            if additive:
                columns = [(term.nominal, term.half, None) for term in additive]
            elif rule["from"] == "*":
                columns = [*(("A", "dA", j) for j in range(n)), *(("B", "dB", j) for j in range(m))]
            else:
                j = _position(rule["from"], (*states, *controls), f"{here}: from")
                columns = [("A", "dA", j) if j < n else ("B", "dB", j - n)]
            for i in rows:
                for nominal, half, column in columns:
                    at = (i,) if column is None else (i, column)
                    for key, name in (("nominal", nominal), ("half_width", half)):
                        if key in rule:
                            if not name:
                                raise FitError(f"{here}: {rule['from']} has no nominal value; say half_width")
                            low, high = _range(rule[key], f"{here}: {key}")
                            structure.lower[name][at] = (
                                max(low, 0.0) if name in HALF_WIDTHS and low == -math.inf else low
                            )
                            structure.upper[name][at] = high
        return cls(n, m, lower=structure.lower, upper=structure.upper)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file; null for no bound.

        Returns
        -------
        dict
            `lower` and `upper`, each by the names of `Structure`.
        """

        def plain(values: Any) -> Any:
            return [plain(v) for v in values] if isinstance(values, list) else values if math.isfinite(values) else None

        return {
            side: {name: plain(array.tolist()) for name, array in getattr(self, side).items()}
            for side in ("lower", "upper")
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], n: int, m: int) -> Structure:
        """From what `to_dict` returned.

        Parameters
        ----------
        data : mapping of str to object
            Of a model file.
        n : int
            Number of states.
        m : int
            Number of controls.

        Returns
        -------
        Structure
            The structure.

        Raises
        ------
        FitError
            It is not of that form.
        """

        def arrays(side: str) -> dict[str, Array]:
            try:
                return {name: np.array(values, dtype=np.float64) for name, values in data[side].items() if values}
            except (AttributeError, KeyError, TypeError, ValueError):
                raise FitError("structure: the model file does not hold it as it was written; fit again") from None

        shaped = {side: {k: v for k, v in arrays(side).items() if v.size} for side in ("lower", "upper")}
        return cls(n, m, lower=shaped["lower"], upper=shaped["upper"])

    def stacked(self, names: Collection[str]) -> tuple[Array, Array, Array, Array]:
        """Bounds in the order of the unknowns.

        Parameters
        ----------
        names : collection of str
            Arrays of the additive terms that the fit has.

        Returns
        -------
        array (r, n)
            Lower bounds of theta.
        array (r, n)
            Upper bounds of theta.
        array (q, n)
            Lower bounds of d.
        array (q, n)
            Upper bounds of d.

        Raises
        ------
        FitError
            An additive element is fixed to a number other than 0, and the fit does not have that term.
        """
        additive = [name for which in ("nominal", "half") for term in ADDITIVE if (name := getattr(term, which))]
        for name in additive:
            forced = (self.lower[name] > 0) | (self.upper[name] < 0)
            if name not in names and forced.any():
                raise FitError(f"structure: {name} is not 0, and the fit has no such term; choose another additive")
        sides = []
        for side in (self.lower, self.upper):
            theta, d = (
                [
                    np.atleast_2d(side[name].T)
                    for term in TERMS
                    if (name := getattr(term, which)) and (term.required or name in names)
                ]
                for which in ("nominal", "half")
            )
            sides.append((np.vstack(theta), np.vstack(d)))
        return sides[0][0], sides[1][0], sides[0][1], sides[1][1]


def _position(name: Any, names: Sequence[str], where: str) -> int:
    if name not in names:
        raise FitError(f"{where}: there is no '{name}'; there are {', '.join(names)}")
    return list(names).index(name)


def _range(value: Any, where: str) -> tuple[float, float]:
    if isinstance(value, dict) and value and set(value) <= {"min", "max"}:
        low, high = value.get("min", -math.inf), value.get("max", math.inf)
    else:
        low = high = value
    for number in (low, high):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or math.isnan(number):
            raise FitError(f"{where} is {value!r}; write a number, or {{min: a, max: b}}")
    return float(low), float(high)
