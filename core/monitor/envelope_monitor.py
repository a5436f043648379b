"""EnvelopeMonitor: samples in, verdicts and alarm out; the only place where either is made."""

from __future__ import annotations

import math
import operator
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, times
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.html_table import html_table, name_with_unit, number_text
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.operating_point import OperatingPoint
from uncertain_lti.sampling.sampler import Status, Step
from uncertain_lti.sampling.transient import Transient

NUMBERS = ("flags", "lower", "upper", "state", "utilisation")
"""What a verdict says of each state."""
_SMALL = 150  # elements of [A B] up to which plain floats are faster than arrays


class Verdict:
    """What the monitor says of one clock message.

    flags (n,): 0 contained, 1 violated, NaN no verdict. lower, upper, state (n,): the bounds that were judged and
    the sample, in recorded units; NaN where there is none. utilisation (n,): (x_next - centre) / half with half
    before the margin. outside_domain: z(t_k) lies outside the ranges seen in the fit. alarm: after this verdict.

    A live monitor makes one per message, and often nobody asks for more than the alarm: numbers are worked out where
    they are asked for, by `numbers`, by `packed`, or as a new array by the attribute of that name.
    """

    __slots__ = ("t_ns", "arrival_ns", "status", "outside_domain", "alarm", "_after", "_judgement")

    def __init__(self, step: Step, outside_domain: bool, alarm: bool, judgement: _Floats | _Arrays | None) -> None:
        self.t_ns, self.arrival_ns, self.status = step.t_ns, step.arrival_ns, step.status
        self._after = step.after
        self.outside_domain, self.alarm = outside_domain, alarm
        self._judgement = judgement

    def __repr__(self) -> str:
        if not self.judged:
            return f"Verdict({self.status.value}: no verdict)"
        left = int((self.flags == 1.0).sum())
        said = f"{left} of {plural(len(self.flags), 'state')} violated" if left else "contained"
        return f"Verdict({said}{', outside the fitted domain' * self.outside_domain}{', ALARM' * self.alarm})"

    @property
    def judged(self) -> bool:
        """Whether there is a verdict, the message being neither dropped nor without a complete transition."""
        return self._judgement is not None

    @property
    def violated(self) -> bool:
        """Some state left its bounds."""
        return self._judgement is not None and not self._judgement.contained

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self._after)

    def numbers(self, name: str) -> list[float]:
        """One of `NUMBERS`, n floats."""
        if name == "state":
            return list(self._after)
        if self._judgement is None:
            return [math.nan] * len(self._after)
        found = getattr(self._judgement, name)()
        return found if isinstance(found, list) else list[float](found.tolist())

    def packed(self, name: str) -> bytes:
        """The same as little-endian doubles."""
        found = self._after
        if name != "state":
            found = [math.nan] * len(found) if self._judgement is None else getattr(self._judgement, name)()
        return _packer(len(found))(*found) if isinstance(found, list) else bytes(np.asarray(found, "<f8").tobytes())

    @property
    def flags(self) -> Array:
        """0 contained, 1 violated, NaN no verdict (n,)."""
        return np.array(self.numbers("flags"), dtype=np.float64)

    @property
    def state(self) -> Array:
        """The sample judged, in recorded units (n,)."""
        return np.array(self._after, dtype=np.float64)

    @property
    def lower(self) -> Array:
        """Lower bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("lower"), dtype=np.float64)

    @property
    def upper(self) -> Array:
        """Upper bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("upper"), dtype=np.float64)

    @property
    def utilisation(self) -> Array:
        """Where between its bounds the sample lies (n,)."""
        return np.array(self.numbers("utilisation"), dtype=np.float64)


@cache
def _packer(n: int) -> Callable[..., bytes]:
    return struct.Struct(f"<{n}d").pack


class _Floats:
    """Centre, half-width, bounds and sample of one verdict, normalised, n each; where the sample is inside."""

    __slots__ = ("point", "centre", "half", "low", "high", "x_next", "inside", "contained")

    def __init__(self, point: list[tuple[float, float]], x_next: list[float]) -> None:
        self.point, self.x_next = point, x_next
        self.centre, self.half, self.low, self.high = list[float](), list[float](), list[float](), list[float]()
        self.inside: list[bool] = []
        self.contained = True

    def contained_or(self, uncounted: NDArray[np.bool_]) -> bool:
        return all(map(operator.or_, self.inside, uncounted.tolist()))

    def flags(self) -> list[float]:
        return [0.0 if inside else 1.0 for inside in self.inside]

    def lower(self) -> list[float]:
        return [steady + scale * value for (steady, scale), value in zip(self.point, self.low, strict=True)]

    def upper(self) -> list[float]:
        return [steady + scale * value for (steady, scale), value in zip(self.point, self.high, strict=True)]

    def utilisation(self) -> list[float]:
        return [_ratio(x - c, half) for x, c, half in zip(self.x_next, self.centre, self.half, strict=True)]


class _Arrays:
    """The same as arrays (n,)."""

    __slots__ = ("point", "centre", "half", "low", "high", "x_next", "inside", "contained")

    def __init__(
        self, point: OperatingPoint, centre: Array, half: Array, low: Array, high: Array, x_next: Array
    ) -> None:
        self.point, self.centre, self.half = point, centre, half
        self.low, self.high, self.x_next = low, high, x_next
        self.inside = (low <= x_next) & (x_next <= high)
        self.contained = bool(self.inside.all())

    def contained_or(self, uncounted: NDArray[np.bool_]) -> bool:
        return bool((self.inside | uncounted).all())

    def flags(self) -> Array:
        return np.subtract(1.0, self.inside, dtype=np.float64)

    def lower(self) -> Array:
        return self.point.recorded_x(self.low)

    def upper(self) -> Array:
        return self.point.recorded_x(self.high)

    def utilisation(self) -> Array:
        return _utilisation(self.x_next - self.centre, self.half)


@dataclass(frozen=True, repr=False)
class Verdicts:
    """Verdicts over one transient, one row per sample k = 0..N; row k judges the arrival at t_k.

    flags, lower, upper, utilisation (N+1, n) as in `Verdict`; judged, outside_domain, alarm (N+1,).
    """

    transient: Transient
    flags: Array
    lower: Array
    upper: Array
    utilisation: Array
    judged: NDArray[np.bool_]
    outside_domain: NDArray[np.bool_]
    alarm: NDArray[np.bool_]

    def __repr__(self) -> str:
        judged, left = int(self.judged.sum()), int(self.violated.sum())
        raised = int(np.count_nonzero(np.diff(np.concatenate([[False], self.alarm]).astype(np.int8)) == 1))
        said = f"{1 - left / judged:.3%} inside all bounds" if judged else "none possible"
        alarm = f"alarm raised {times(raised)}" if raised else "no alarm"
        return f"Verdicts({self.transient.name!r}: {plural(judged, 'verdict')}, {said}, {alarm})"

    def _repr_html_(self) -> str:
        """Violations and widths of each state."""
        transient, judged = self.transient, self.judged
        count, rows = int(judged.sum()), []
        units = [s.unit for s in transient.signals.states] if transient.signals else [""] * self.flags.shape[1]
        for i, (name, unit) in enumerate(zip(transient.state_names, units, strict=True)):
            bad = np.flatnonzero(self.flags[:, i] == 1.0)
            width = (self.upper - self.lower)[judged, i]
            rows.append(
                [
                    name_with_unit(name, unit),
                    str(len(bad)),
                    f"{1 - len(bad) / count:.3%}" if count else "–",
                    number_text(float(width.mean())) if count else "–",
                    number_text(float(width.max())) if count else "–",
                    f"{transient.t[bad[0]]:.4f} s" if len(bad) else "–",
                ]
            )
        return html_table(repr(self), ("state", "violations", "inside", "mean width", "largest", "first"), rows)

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Whether some state left its bounds, (N+1,)."""
        left: NDArray[np.bool_] = (self.flags == 1.0).any(axis=1)
        return left


class EnvelopeMonitor:
    """Judges one-step transitions by the bounds of a model, and raises the alarm when m of n are violations.

    A sample is contained when lower <= x_next <= upper in the normalised quantities, nothing else (Leibov (2006),
    eqs. (8)(9)). The alarm looks at the last `window` verdicts (messages without a verdict do not count) and
    starts anew when time jumps back.

    Parameters
    ----------
    model : UncertainLTI
    violations, window, margin : optional
        In place of those in the model.
    masked : sequence of str
        States that are judged like the others, and whose violations never count for the alarm.

    Raises
    ------
    ModelError
        violations, window or margin are out of range, or masked names no state of the model, or all.
    """

    def __init__(
        self,
        model: UncertainLTI,
        violations: int | None = None,
        window: int | None = None,
        margin: float | None = None,
        masked: Sequence[str] = (),
    ) -> None:
        said = model.alarm_rule
        self.model = model
        self.rule = AlarmRule(
            said.violations if violations is None else violations,
            said.window if window is None else window,
            said.margin if margin is None else margin,
        )
        names = model.state_names
        for name in masked:
            if name not in names:
                raise ModelError(f"masked state '{name}' is not in the model; its states are {', '.join(names)}")
        self.masked = tuple(name for name in names if name in masked)
        if len(self.masked) == len(names):
            raise ModelError("every state of the model is masked; leave at least one that can raise the alarm")
        self._counted = np.array([name not in masked for name in names])
        self._uncounted, self._all_count = ~self._counted, not self.masked
        point, domain = model.operating_point, model.domain
        # z(t_k) = [x; u] and x_next beside each other, as both are normalised alike
        self._steady = np.concatenate((point.x_s, point.u_s, point.x_s))
        self._scale = np.concatenate((point.X, point.U, point.X))
        self._least = np.concatenate((domain.x_min, domain.u_min))
        self._greatest = np.concatenate((domain.x_max, domain.u_max))
        self._limited = bool(np.isfinite(self._least).any() or np.isfinite(self._greatest).any())
        size = model.n + model.m
        self._small = model.n * size <= _SMALL
        self._point = list(zip(self._steady[:size].tolist(), self._scale[:size].tolist(), strict=True))
        self._point_x = self._point[: model.n]
        self._limits = list(zip(self._least.tolist(), self._greatest.tolist(), strict=True))
        self._rows = [
            (a[0], d[0], list(zip(a[1:], d[1:], strict=True)), c, dc, v)
            for a, d, c, dc, v in zip(*(row.tolist() for row in self.rows), strict=True)
        ]
        self.alarm = False
        self._recent: deque[bool] = deque()
        self._violations = 0  # among the recent verdicts

    def __repr__(self) -> str:
        rule = self.rule
        masked = f", {', '.join(self.masked)} masked" if self.masked else ""
        return (
            f"EnvelopeMonitor({self.model!r}; alarm {rule.violations} of {rule.window}, margin {rule.margin:g}{masked})"
        )

    def reset(self) -> None:
        """Forget the recent verdicts and the alarm."""
        self._recent.clear()
        self._violations = 0
        self.alarm = False

    def predict(self, x: ArrayLike, u: ArrayLike, dt: float) -> tuple[Array, Array]:
        """Bounds (lower, upper), each (n,), one step of dt s after x (n,), u (m,); all in recorded units."""
        z = np.concatenate((np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)))
        verdict = self.expect(0, z.tolist(), dt)
        return verdict.lower, verdict.upper

    def expect(self, t_ns: int, z: Sequence[float], dt: float) -> Verdict:
        """`predict` for the instant t_ns after z = [x; u]: lower and upper of a verdict that counts nowhere."""
        return self.look(Step(Status.OK, t_ns, 0, dt, z, z[: self.model.n]))

    def look(self, step: Step) -> Verdict:
        """Verdict on a complete step that counts nowhere."""
        judgement, outside = self._by_floats(step) if self._small else self._by_arrays(step)
        return Verdict(step, outside, self.alarm, judgement)

    @property
    def window(self) -> bytes:
        """The verdicts that the alarm looks at, oldest first; 1 for a violation that counts."""
        return bytes(self._recent)

    def go_on(self, window: bytes) -> None:
        """The verdicts that the alarm looks at were given elsewhere, and the alarm has not turned."""
        self._recent = deque(map(bool, window))
        self._violations = sum(window)

    @property
    def counted(self) -> bytes:
        """Of each state whether its violations count for the alarm (n,)."""
        return self._counted.tobytes()

    @property
    def rows(self) -> tuple[Array, Array, Array, Array, Array]:
        """[A B], [dA dB] (n, n + m), c, dc, v (n,) as the bounds take them."""
        model = self.model
        return np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB]), model.c, model.dc, model.v

    @property
    def point(self) -> tuple[Array, Array, Array, Array]:
        """Steady values, scales, and the least and greatest normalised values seen in the fit, of [x; u] (n + m,)."""
        size = self.model.n + self.model.m
        return self._steady[:size], self._scale[:size], self._least, self._greatest

    def judge(self, step: Step, armed: bool = True) -> Verdict:
        """Verdict on one step of the sampler.

        armed: whether it may count for the alarm; otherwise there is none, and the window starts anew.
        """
        if step.status is Status.RESET or not armed:
            self.reset()
        if step.status is not Status.OK:
            return Verdict(step, False, self.alarm, None)
        judgement, outside = self._by_floats(step) if self._small else self._by_arrays(step)
        if armed:
            self._count(not (judgement.contained if self._all_count else judgement.contained_or(self._uncounted)))
        return Verdict(step, outside, self.alarm, judgement)

    # The two below, and `_judge`, do the same operations on each element in the same order, for the same bits.

    def _by_arrays(self, step: Step) -> tuple[_Arrays, bool]:
        n, margin = self.model.n, self.rule.margin
        normalised = (np.array([*step.before, *step.after], dtype=np.float64) - self._steady) / self._scale
        z = normalised[:-n]
        centre, half = self.model.one_centre_and_half(z, step.dt)
        judged = half if margin == 1.0 else half * margin
        outside = self._limited and bool(((z < self._least) | (z > self._greatest)).any())
        point = self.model.operating_point
        return _Arrays(point, centre, half, centre - judged, centre + judged, normalised[-n:]), outside

    def _by_floats(self, step: Step) -> tuple[_Floats, bool]:
        margin, dt, point = self.rule.margin, step.dt, self._point
        z = [(value - steady) / scale for value, (steady, scale) in zip(step.before, point, strict=True)]
        x_next = [(value - steady) / scale for value, (steady, scale) in zip(step.after, point, strict=False)]
        size = [abs(value) for value in z]
        (z0, *z_others), (s0, *s_others) = z, size
        found = _Floats(self._point_x, x_next)
        for x, after, (a0, d0, others, c, dc, v) in zip(z, x_next, self._rows, strict=False):
            rate, spread = a0 * z0, d0 * s0
            for (a, d), zj, sj in zip(others, z_others, s_others, strict=True):
                rate += a * zj
                spread += d * sj
            centre, half = (rate + c) * dt + x, (spread + dc) * dt + v
            judged = half if margin == 1.0 else half * margin
            low, high = centre - judged, centre + judged
            inside = low <= after <= high
            found.contained &= inside
            found.centre.append(centre)
            found.half.append(half)
            found.low.append(low)
            found.high.append(high)
            found.inside.append(inside)
        return found, self._limited and any(
            value < least or value > most for value, (least, most) in zip(z, self._limits, strict=True)
        )

    def _count(self, violated: bool) -> None:
        recent = self._recent
        if len(recent) == self.rule.window:
            self._violations -= recent.popleft()
        recent.append(violated)
        self._violations += violated
        self.alarm = self._violations >= self.rule.violations

    def check(self, transient: Transient) -> Verdicts:
        """Verdicts over a whole transient, from a cleared alarm; the same bits as `judge` step by step.

        Raises
        ------
        ModelError
            The transient has other numbers of states or controls than the model.
        """
        model, point = self.model, self.model.operating_point
        if transient.x.shape[1] != model.n or transient.u.shape[1] != model.m:
            raise ModelError(
                f"{transient.name}: {plural(transient.x.shape[1], 'state')} and "
                f"{plural(transient.u.shape[1], 'control')}, and the "
                f"model has {model.n} and {model.m}"
            )
        steps = transient.transitions()
        count, n = len(transient), model.n
        arrival = steps.k + 1
        flags, lower = np.full((count, n), np.nan), np.full((count, n), np.nan)
        upper, utilisation = np.full((count, n), np.nan), np.full((count, n), np.nan)
        judged, outside = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        x, u = point.normalise_x(steps.x), point.normalise_u(steps.u)
        x_next = point.normalise_x(steps.x_next)
        flags[arrival], low, high, utilisation[arrival] = self._judge(x, u, steps.dt, x_next)
        lower[arrival], upper[arrival] = point.recorded_x(low), point.recorded_x(high)
        judged[arrival] = True
        outside[arrival] = model.domain.outside(x, u)
        violated = ((flags == 1.0) & self._counted).any(axis=1)
        alarm = np.zeros(count, dtype=bool)
        resets = np.flatnonzero(np.diff(transient.t_ns) < 0) + 1
        for start, stop in zip([0, *resets], [*resets, count], strict=True):
            alarm[start:stop] = self._m_of_n(judged[start:stop], violated[start:stop])
        return Verdicts(transient, flags, lower, upper, utilisation, judged, outside, alarm)

    def _judge(self, x: Array, u: Array, dt: Array | np.float64, x_next: Array) -> tuple[Array, Array, Array, Array]:
        """flags, lower, upper (normalised), utilisation of transitions (..., n), (..., m), (...), (..., n)."""
        centre, half = self.model.centre_and_half(x, u, dt)
        judged_half = half * self.rule.margin
        lower, upper = centre - judged_half, centre + judged_half
        inside = (lower <= x_next) & (x_next <= upper)
        flags = np.where(inside, 0.0, 1.0)
        return flags, lower, upper, _utilisation(x_next - centre, half)

    def _m_of_n(self, judged: NDArray[np.bool_], violated: NDArray[np.bool_]) -> NDArray[np.bool_]:
        total = np.concatenate([[0], np.cumsum(violated[judged])])
        ends = np.arange(1, len(total))
        recent = total[ends] - total[np.maximum(ends - self.rule.window, 0)]
        raised = np.concatenate([[False], recent >= self.rule.violations])
        held: NDArray[np.bool_] = raised[np.cumsum(judged)]  # without a verdict the last one stands
        return held


def _ratio(difference: float, half: float) -> float:
    if difference == 0.0:
        return 0.0
    if half == 0.0:
        return math.copysign(math.inf, difference) if difference == difference else difference
    return difference / half


def _utilisation(difference: Array, half: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(difference == 0.0, 0.0, difference / half)
