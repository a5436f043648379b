"""What `check` prints of these facts."""

from __future__ import annotations

from typing import Any

from uncertain_lti.base.english import plural, times
from uncertain_lti.reports.tables import number, table


def check_text(data: dict[str, Any]) -> str:
    """Summary of `check_data` for a person.

    Parameters
    ----------
    data : dict
        Of `check_data`.

    Returns
    -------
    str
        A table in recorded units, and when the alarm was raised.
    """
    rows = []
    for name, s in data["states"].items():
        longest = s["longest_violation"]
        rows.append(
            [
                name + (f" [{s['unit']}]" if s["unit"] else ""),
                str(s["violations"]),
                "-" if s["inside"] is None else f"{s['inside']:.3%}",
                number(s["mean_width"]),
                number(s["max_width"]),
                "-" if s["first_violation"] is None else f"{s['first_violation']['t']:.4f} s",
                "-" if longest is None else f"{longest['samples']} from {longest['t']:.4f} s",
            ]
        )
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} inside all bounds"
    head = f"{data['recording']}: {plural(data['samples'], 'sample')}, {plural(data['verdicts'], 'verdict')}, {inside}"
    lines = [
        head + (f"; no verdict or not used: {', '.join(data['no_verdict'])}" if data["no_verdict"] else ""),
        table(("state", "violations", "inside", "mean width", "largest", "first", "longest"), rows),
    ]
    if data["verdicts"]:
        lines.append(f"outside the fitted domain: {data['outside_domain'] / data['verdicts']:.2%} of the verdicts")
    if data["alarm"]:
        first = data["alarms"][0]
        lines.append(
            f"ALARM: raised {times(len(data['alarms']))}, first at {first['t']:.4f} s for {number(first['seconds'])} s"
        )
    elif data["outcome"] == "unknown" and data["verdicts"]:
        lines.append(f"no alarm, but UNKNOWN: {data['reason']}")
    else:
        lines.append("no alarm" if data["verdicts"] else data["reason"])
    return "\n".join(lines)
