"""What `report` prints of the findings."""

from __future__ import annotations

from typing import Any

from uncertain_lti.reports.reliance import WEIGHTS


def findings_text(facts: dict[str, Any]) -> str:
    """The answers of `findings.findings`, with the reasons, for a person.

    Parameters
    ----------
    facts : dict
        Of `findings.findings`.

    Returns
    -------
    str
        Both answers, a reason per line, what weighs most first.
    """
    lines = [f"may I rely on it? {facts['rely']['answer']}"]
    reasons = sorted(facts["rely"]["reasons"], key=lambda r: WEIGHTS.index(r["weight"]))
    lines += [f"  {r['weight']}: {r['text']}" for r in reasons]
    lines.append("what happened?")
    lines += [f"  {h['recording']}: {h['text']}" for h in facts["happened"]]
    return "\n".join(lines)
