# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Signatures of labelled faulty recordings, and how far the labels can be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.model.signature import Signature, closeness
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.likeness import AHEAD, LEAST, MATCH, Pattern, scaled
from uncertain_lti.monitor.verdict import Verdicts


@dataclass(frozen=True)
class Learnt:
    """What labelled recordings gave.

    `signatures`: those of the model, with the new ones; `named`: of each recording its name, its label, and the label
    that the signatures of the other recordings give it; empty for unknown, or where there is no other recording of its
    label; `alike`: pairs of labels that cannot be told apart, with their match.
    """

    signatures: tuple[Signature, ...]
    named: tuple[tuple[str, str, str], ...]
    alike: tuple[tuple[str, str, float], ...]


def learn_signatures(model: UncertainLTI, labelled: Sequence[tuple[str, Verdicts]], replace: bool = False) -> Learnt:
    """Signatures from recordings of known faults.

    Parameters
    ----------
    model : UncertainLTI
        What the recordings were checked with.
    labelled : sequence of (str, Verdicts)
        Each recording with its label.
    replace : bool, default False
        Whether a label that the model has already is learnt again.

    Returns
    -------
    Learnt
        One signature per label, the mean over its recordings, however long they are.

    Raises
    ------
    ModelError
        The alarm was on for fewer than `LEAST` verdicts of a recording, or the model has the label.
    """
    known = {signature.label for signature in model.signatures}
    alone: list[Signature] = []
    for label, verdicts in labelled:
        if label in known and not replace:
            raise ModelError(f"the model has a signature '{label}'; give another label, or replace it with --force")
        alone.append(_of_recording(model, label, verdicts))
    labels = list(dict.fromkeys(label for label, _ in labelled))
    new = {label: _mean([s for s in alone if s.label == label]) for label in labels}
    kept = tuple(s for s in model.signatures if s.label not in new)
    signatures = (*kept, *new.values())
    named = []
    for i, (label, verdicts) in enumerate(labelled):
        others: dict[str, list[Signature]] = {}
        for j, signature in enumerate(alone):
            if j != i:
                others.setdefault(signature.label, []).append(signature)
        rest = [*kept, *(_mean(found) for found in others.values())]
        match = sorted(((closeness(alone[i], s), s.label) for s in rest), reverse=True)
        clear = bool(match) and match[0][0] >= MATCH and (len(match) == 1 or match[0][0] - match[1][0] >= AHEAD)
        named.append((verdicts.transient.name, label, match[0][1] if clear and label in others else ""))
    pairs = ((a, b, closeness(a, b)) for i, a in enumerate(signatures) for b in signatures[:i])
    return Learnt(signatures, tuple(named), tuple((b.label, a.label, c) for a, b, c in pairs if c >= MATCH))


def _of_recording(model: UncertainLTI, label: str, verdicts: Verdicts) -> Signature:
    rows = np.flatnonzero(verdicts.judged & verdicts.alarm)
    if len(rows) < LEAST:
        on = f"the alarm was on for {plural(len(rows), 'verdict')} only" if len(rows) else "no alarm was raised"
        raise ModelError(
            f"{verdicts.transient.name}: {on}, so it has no signature; give a recording of '{label}' that the rule "
            f"sees, or a rule that sees it (--violations, --window, --margin)"
        )
    pattern = Pattern((1, *(horizon.steps for horizon in model.horizons)), model.n)
    table, zeros = verdicts.horizon_utilisation[rows], np.zeros(model.n)
    for row in table:
        pattern.add(row, zeros)
    return pattern.signature(label)


def _mean(signatures: Sequence[Signature]) -> Signature:
    first = signatures[0]
    moments = scaled(np.mean([s.moments for s in signatures], axis=0))
    return Signature(first.label, first.steps, moments, len(signatures), sum(s.verdicts for s in signatures))
