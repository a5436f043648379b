"""What `info` prints of a model."""

from __future__ import annotations

import numpy as np

from uncertain_lti.base.english import plural
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.tables import number, table


def model_text(model: UncertainLTI) -> str:
    """Summary of a model file.

    Parameters
    ----------
    model : UncertainLTI
        The model.

    Returns
    -------
    str
        Signals, matrices in 1/s of normalised quantities, domain, alarm rule and notes.
    """
    s, facts = model.sampling, model.fit_summary
    lines = [repr(model)]
    if s.clock:
        lines.append(
            f"clock {s.clock} ({s.time.get(s.clock, '?')} time), step {number(s.dt_median)} s "
            f"({number(s.dt_min)} to {number(s.dt_max)}), max_gap {number(s.max_gap)} s"
        )
    signals = [
        [
            f"{kind} {signal.name}",
            signal.topic or "-",
            signal.field,
            number(float(signal.steady)),
            number(float(signal.scale)),
            signal.unit or "-",
        ]
        for kind, group in (("state", model.signals.states), ("control", model.signals.controls))
        for signal in group
    ]
    lines.append(table(("signal", "topic", "field", "steady", "scale", "unit"), signals))
    names = [*model.state_names, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    shown = [
        (term.nominal or f"{term.half} ({term.word})", np.column_stack(pair))
        for term, *pair in model.additive()
        if np.any(pair)
    ]
    rows = [
        [name]
        + [f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in range(len(names))]
        + [f"{pair[i, 0]:.4g} ± {pair[i, 1]:.3g}" for _, pair in shown]
        for i, name in enumerate(model.state_names)
    ]
    lines.append(table(("A, B [1/s]", *names, *(name for name, _ in shown)), rows))
    lines.append(f"eigenvalues of A [1/s]: {eigenvalues_text(model)}")
    if facts.get("mean_width_recorded"):
        widths = [
            [name, number(a), number(b)]
            for name, a, b in zip(
                model.state_names, facts["mean_width_recorded"], facts["max_width_recorded"], strict=True
            )
        ]
        lines.append(table(("one-step envelope", "mean width", "largest"), widths))
    alarm = model.alarm_rule
    lines.append(
        f"alarm: {alarm.violations} of the last {plural(alarm.window, 'verdict')} violated; margin "
        f"{number(alarm.margin)}"
    )
    return "\n".join(lines + [f"note: {message}" for message in facts.get("messages", [])])


def eigenvalues_text(model: UncertainLTI) -> str:
    """Eigenvalues of A in one line.

    Parameters
    ----------
    model : UncertainLTI
        Any model.

    Returns
    -------
    str
        Numbers with four digits, 1/s.
    """
    return ", ".join(
        f"{v.real:.4g}{v.imag:+.4g}j" if abs(v.imag) > 1e-12 * abs(v) else f"{v.real:.4g}" for v in model.eigenvalues()
    )
