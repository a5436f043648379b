# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Find the alarm rule for a rate of false alarms, on recordings that are left out of the fit in turn."""

from dataclasses import replace
from pathlib import Path

from uncertain_lti import EnvelopeMonitor, fit, read_transients, validate
from uncertain_lti.validation.calibration import calibrate

ROOT = Path(__file__).resolve().parents[1]
TARGET = 600  # false alarms per hour at most: the recordings are two minutes long and cannot show less


def main() -> None:
    """Fit, leave out, calibrate, and use the rule on a run with a fault at 24 s."""
    bags = ROOT / "bags"
    names = ("pulses_up_large_noise", "pulses_down_large_noise", "levels_noise")
    runs = read_transients([bags / f"turbofan_{n}.mcap" for n in names], ROOT / "config" / "signals" / "turbofan.yaml")
    model = fit(runs, criterion="lp", additive="noise")

    validation = validate(model, runs, blocks=10)
    calibration = calibrate(validation, TARGET)
    print(calibration.words)
    if calibration.alarm_rule is None:
        return
    model = model.replace(alarm_rule=calibration.alarm_rule)

    (damaged,) = read_transients(bags / "turbofan_fan_damage.mcap", model.signals)
    for rule in (replace(calibration.alarm_rule, margin=1.0), calibration.alarm_rule):
        verdicts = EnvelopeMonitor(model, rule.violations, rule.window, rule.margin).check(damaged)
        first = damaged.t[verdicts.alarm][0]
        print(f"{rule.violations} of {rule.window}, margin {rule.margin:.2f}: first alarm at {first:.3f} s")


if __name__ == "__main__":
    main()
