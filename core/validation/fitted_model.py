# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Validation of a model that was fitted before, with the options that it names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, listed_transients
from uncertain_lti.validation import left_out
from uncertain_lti.validation.result import Validation


def validate(
    subject: UncertainLTI | Sequence[Transient] | Transient,
    transients: Sequence[Transient] | Transient | None = None,
    **options: Any,
) -> Validation:
    """Leave out one recording or group at a time, fit to the others, and judge what was left out.

    `validate(model, runs)` fits with the model's own settings: criterion, additive terms, structure, discards, schedule
    and the groups of its fit. `validate(runs)` fits as `fit(runs)` does.

    Parameters
    ----------
    subject : UncertainLTI, Transient or sequence of Transient
        A fitted model; or the recordings.
    transients : Transient or sequence of Transient, optional
        With a model, the recordings that it was fitted to.
    **options : object
        With a model those of `validate_model` (blocks, gap, groups, confidence, progress); else those of
        `left_out.validate`, which takes those of `fit` as well (criterion, additive, ...).

    Returns
    -------
    Validation
        The parts, each judged by the model that was fitted without it.

    Raises
    ------
    FitError
        As of `validate_model` and `left_out.validate`; or a model is given without recordings, or recordings twice.
    """
    if isinstance(subject, UncertainLTI):
        if transients is None:
            raise FitError("a model alone says nothing; give the recordings it was fitted to: validate(model, runs)")
        runs = listed_transients(transients)
        if further := sorted(set(options) - {"blocks", "gap", "groups", "confidence", "progress"}):
            raise FitError(
                f"{', '.join(further)}: a model is validated with its own settings; leave this out, or give the "
                f"recordings alone: validate(runs, {further[0]}=...)"
            )
        return validate_model(subject, runs, **options)
    if transients is not None:
        raise FitError("recordings are given twice; write validate(model, runs) or validate(runs)")
    return left_out.validate(subject, **options)


def validate_model(
    model: UncertainLTI,
    transients: Sequence[Transient],
    *,
    blocks: int | None = None,
    gap: float | None = None,
    groups: Sequence[Any] | str | None = None,
    confidence: float = 0.9,
    progress: Callable[[str], None] | None = None,
) -> Validation:
    """Validate a fitted model, or one from a file, with the recordings it was fitted to and the options it names.

    The key by which its file says that the recordings are grouped, `fit --group`, applies unless groups or blocks are
    given.
    """
    if isinstance(groups, str) and groups == "none":
        groups = None
    elif groups is None and blocks is None:
        groups = model.fit_summary.get("group")
    if progress is not None:
        progress("the fit to all recordings")
    again = fit(transients, operating_point=model.operating_point, schedule=model.schedule or {}, **_options(model))
    if not _same(again, model):
        raise FitError(
            "these recordings do not give this model again, so what was left out of them would say nothing about it; "
            "name the recordings it was fitted to, or fit it again"
        )
    return left_out.validate(
        transients,
        operating_point=model.operating_point,
        alarm_rule=model.alarm_rule,
        blocks=blocks,
        gap=gap,
        groups=groups,
        confidence=confidence,
        full=again,
        progress=progress,
        **_options(model),
    )


def _options(model: UncertainLTI) -> Mapping[str, Any]:
    """Options of `fit` with which a model was fitted; see `validate_model`."""
    facts = model.fit_summary
    for key in ("criterion", "additive"):
        if key not in facts:
            raise FitError(f"the model does not say by which {key} it was fitted; fit it again")
    if facts.get("weights", "ones") != "ones":
        raise FitError("the model was fitted with weights, which its file does not hold; use validate() from Python")
    options: dict[str, Any] = {"criterion": facts["criterion"], "additive": facts["additive"]}
    options |= {key: facts[key] for key in ("discard", "count") if key in facts}
    if "structure" in facts:
        options["structure"] = Structure.from_dict(facts["structure"], model.n, model.m)
    return options


def _same(one: UncertainLTI, other: UncertainLTI) -> bool:
    """The same widths from as many transitions; another numpy may round otherwise, so not to the bit."""
    if one.fit_summary["transitions"] != other.fit_summary.get("transitions"):
        return False
    return np.allclose(one.fit_summary["mean_width"], np.asarray(other.fit_summary["mean_width"]), rtol=1e-6, atol=0.0)
