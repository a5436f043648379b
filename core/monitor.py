"""EnvelopeMonitor: samples in, verdicts and alarm out; the only place where either is made."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import ModelError
from uncertain_lti.model import Alarm, UncertainLTI
from uncertain_lti.operating_point import OperatingPoint
from uncertain_lti.sampler import Status, Step
from uncertain_lti.transient import Transient

Array = NDArray[np.float64]


class Verdict:
    """What the monitor says of one clock message.

    flags (n,): 0 contained, 1 violated, NaN no verdict. lower, upper, state (n,): the bounds that were judged and
    the sample, in recorded units; NaN where there is none. utilisation (n,): (x_next - centre) / half with half
    before the margin. outside_domain: z(t_k) lies outside the ranges seen in the fit. alarm: after this verdict.

    A live monitor makes one per message, and often nobody asks for more than the flags: the rest is worked out where
    it is asked for.
    """

    __slots__ = ("t_ns", "arrival_ns", "status", "flags", "state", "outside_domain", "alarm", "_judgement")

    def __init__(
        self, step: Step, flags: Array, outside_domain: bool, alarm: bool, judgement: _Judgement | None
    ) -> None:
        self.t_ns, self.arrival_ns, self.status = step.t_ns, step.arrival_ns, step.status
        self.flags, self.state = flags, step.x_next
        self.outside_domain, self.alarm = outside_domain, alarm
        self._judgement = judgement

    @property
    def judged(self) -> bool:
        """There is a verdict: the message is neither dropped nor without a complete transition."""
        return self._judgement is not None

    @property
    def lower(self) -> Array:
        """Lower bound that was judged, in recorded units (n,)."""
        return self.flags if self._judgement is None else self._judgement.recorded(self._judgement.lower)

    @property
    def upper(self) -> Array:
        """Upper bound that was judged, in recorded units (n,)."""
        return self.flags if self._judgement is None else self._judgement.recorded(self._judgement.upper)

    @property
    def utilisation(self) -> Array:
        """Where between its bounds the sample lies (n,)."""
        return self.flags if self._judgement is None else self._judgement.utilisation()


class _Judgement:
    """Centre, half-width, bounds and sample of one verdict, normalised, (n,) each."""

    __slots__ = ("point", "centre", "half", "lower", "upper", "x_next")

    def __init__(
        self, point: OperatingPoint, centre: Array, half: Array, lower: Array, upper: Array, x_next: Array
    ) -> None:
        self.point, self.centre, self.half = point, centre, half
        self.lower, self.upper, self.x_next = lower, upper, x_next

    def recorded(self, x: Array) -> Array:
        return self.point.recorded_x(x)

    def utilisation(self) -> Array:
        return _utilisation(self.x_next - self.centre, self.half)


@dataclass(frozen=True)
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

    @property
    def violated(self) -> NDArray[np.bool_]:
        """(N+1,): some state left its bounds."""
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
        said = model.alarm
        self.model = model
        self.rule = Alarm(
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
        self._steady, self._scale = np.concatenate((point.x_s, point.u_s)), np.concatenate((point.X, point.U))
        self._least = np.concatenate((domain.x_min, domain.u_min))
        self._greatest = np.concatenate((domain.x_max, domain.u_max))
        self._limited = bool(np.isfinite(self._least).any() or np.isfinite(self._greatest).any())
        self._no_flags = np.full(model.n, np.nan)
        self.alarm = False
        self._recent: deque[bool] = deque()
        self._violations = 0  # among the recent verdicts

    def reset(self) -> None:
        """Forget the recent verdicts and the alarm."""
        self._recent.clear()
        self._violations = 0
        self.alarm = False

    def predict(self, x: Array, u: Array, dt: float) -> tuple[Array, Array]:
        """Bounds (lower, upper), each (n,), one step of dt s after x (n,), u (m,); all in recorded units."""
        point = self.model.operating_point
        lower, upper = self.model.bounds(point.normalise_x(x), point.normalise_u(u), dt, margin=self.rule.margin)
        return point.recorded_x(lower), point.recorded_x(upper)

    def judge(self, step: Step, armed: bool = True) -> Verdict:
        """Verdict on one step of the sampler.

        armed: whether it may count for the alarm; otherwise there is none, and the window starts anew.
        """
        if step.status is Status.RESET or not armed:
            self.reset()
        if step.status is not Status.OK:
            return Verdict(step, self._no_flags.copy(), False, self.alarm, None)
        point = self.model.operating_point
        z = (np.concatenate((step.x, step.u)) - self._steady) / self._scale
        x_next = (step.x_next - point.x_s) / point.X
        centre, half = self.model.one_centre_and_half(z, step.dt)
        judged_half = half if self.rule.margin == 1.0 else half * self.rule.margin
        lower, upper = centre - judged_half, centre + judged_half
        inside = (lower <= x_next) & (x_next <= upper)
        outside = self._limited and bool(((z < self._least) | (z > self._greatest)).any())
        if armed:
            counted = inside if self._all_count else inside | self._uncounted
            self._count(not counted.all())
        flags = np.subtract(1.0, inside, dtype=np.float64)
        return Verdict(step, flags, outside, self.alarm, _Judgement(point, centre, half, lower, upper, x_next))

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
                f"{transient.name}: {transient.x.shape[1]} states and {transient.u.shape[1]} controls, and the "
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


def _utilisation(difference: Array, half: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(difference == 0.0, 0.0, difference / half)
