# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""This project beside SENTIL, which monitors formulas: cost per sample, late messages, from bags to the first alarm.

    ./run python benchmarks/temporal_logic.py            # all three; SENTIL from .venv-detection/bin/python, or --peers
    ./run python benchmarks/temporal_logic.py late       # one of them

SENTIL's wheel may live in an environment of its own; make one with

    python3 -m venv .venv-detection && .venv-detection/bin/pip install sentil

What is measured of SENTIL is its Python package. Its node is C++ and wants a ROS 2 workspace; the rule by which it
gathers messages is re-enacted here as its source states it (sentil-ros/src/monitor_node.cpp, on_sample).

--write docs/detection.md replaces the tables of that page between lines <!-- temporal logic NAME -->.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
BAGS = ROOT / "bags"
HEALTHY = sorted(BAGS.glob("turbofan_*_noise.mcap"))
FAULTS = ("fan_damage", "compressor_wear", "nozzle_stuck", "fuel_stuck", "sensor_drift", "sensor_bias")
ONSET, TURNS = 24.0, 7


# --- the part that imports sentil, in an interpreter of its own ---


def formula_of(low: Sequence[float], high: Sequence[float], around: str = "{}") -> str:
    """Every signal in its range, which is widened by a hundredth; robustness in half-ranges."""
    parts = []
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        half = 0.505 * (b - a)
        parts.append(f"abs((z{i} - ({0.5 * (a + b):.17g})) / {half:.17g}) < 1")
    return around.format(" & ".join(parts))


def peer(given: dict[str, Any]) -> dict[str, Any]:
    """Answer one question with SENTIL."""
    import sentil

    rows = given["rows"]
    names = [f"z{i}" for i in range(len(rows[0]["z"]))]
    if given["ask"] == "cost":
        found = {}
        packed = [(row["t"], row["z"]) for row in rows]
        named = [(t, dict(zip(names, z, strict=True))) for t, z in packed]
        for what, around in (("ranges", "{}"), ("ranges over the last 0.5 s", "H[0, 0.5] ({})")):
            for call, samples in (("update", named), ("update_packed", packed)):
                update = getattr(sentil.OnlineMonitor(formula_of(given["low"], given["high"], around)), call)
                began = time.process_time()
                for t, z in samples:
                    update(t, z)
                found[f"SENTIL, {what}, `{call}`"] = (time.process_time() - began) / len(samples)
        return found
    monitor, values, errors = sentil.OnlineMonitor(formula_of(given["low"], given["high"])), [], []
    for row in rows:
        try:
            values.append(monitor.update(row["t"], dict(zip(names, row["z"], strict=True))).value)
        except Exception as error:
            values.append(None)
            errors.append(str(error))
    return {"values": values, "errors": errors, "reads_bag": reads_bag(sentil, given["bag"])}


def reads_bag(sentil: Any, path: str) -> str:
    """What `Trace.from_path` says of a bag."""
    for name in ("from_path", "from_file", "read"):
        if hasattr(sentil.Trace, name):
            try:
                getattr(sentil.Trace, name)(path)
            except Exception as error:
                return str(error).replace("`", "'")
            return "read"
    return "the package has no reader of files"


def asked(peers: str, given: dict[str, Any]) -> dict[str, Any]:
    """The same from the interpreter that has SENTIL."""
    done = subprocess.run(
        [peers, str(Path(__file__).resolve()), "--answer"], input=json.dumps(given), capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"{peers}: {done.stderr.strip().splitlines()[-1]}; see --help for how to install SENTIL")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


# --- this project's part ---


def recorded_ranges(runs: Sequence[Any]) -> tuple[list[float], list[float]]:
    """Least and largest of each state and control."""
    z = np.concatenate([np.hstack([run.x, run.u]) for run in runs])
    return np.nanmin(z, axis=0).tolist(), np.nanmax(z, axis=0).tolist()


def rows_of(run: Any) -> list[dict[str, Any]]:
    """Time and [x u] of every complete sample."""
    t, z = run.t.tolist(), np.hstack([run.x, run.u])
    return [{"t": t[k], "z": z[k].tolist()} for k in np.flatnonzero(np.isfinite(z).all(axis=1)).tolist()]


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return f"**{title}**\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def cost(peers: str) -> str:
    """CPU per sample on the samples of one bag, turns interleaved."""
    from uncertain_lti import EnvelopeMonitor, fit, read_transients
    from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
    from uncertain_lti.sampling.sampler import Step
    from uncertain_lti.sampling.status import Status

    runs = read_transients(HEALTHY, ROOT / "config" / "signals" / "turbofan.yaml")
    (run,) = read_transients(BAGS / "turbofan_levels_noise.mcap", runs[0].signals)
    low, high = recorded_ranges(runs)
    plain = fit(runs)
    much = fit(runs, schedule={"fan_speed": 3}, additive="both", horizons=[10, 20, 40])
    armed = [AlarmRule(), StatisticRule("mean", 2.0, 1.0, 40), StatisticRule("energy", 2.0, 1.0)]
    z, t_ns = np.hstack([run.x, run.u]).tolist(), run.t_ns.tolist()
    steps = [
        Step(Status.OK, t_ns[k + 1], t_ns[k], (t_ns[k + 1] - t_ns[k]) * 1e-9, z[k], z[k + 1][: plain.n])
        for k in range(len(z) - 1)
    ]
    monitors: dict[str, Callable[[], EnvelopeMonitor]] = {
        "this, one step": lambda: EnvelopeMonitor(plain),
        "this, three knots, three horizons, two statistics": lambda: EnvelopeMonitor(much, rules=armed),
    }
    found: dict[str, list[float]] = {}
    for _ in range(TURNS):
        for name, make in monitors.items():
            judge = make().judge
            began = time.process_time()
            for step in steps:
                judge(step)
            found.setdefault(name, []).append((time.process_time() - began) / len(steps))
        answer = asked(peers, {"ask": "cost", "rows": rows_of(run), "low": low, "high": high})
        for name, seconds in answer.items():
            found.setdefault(name, []).append(seconds)
    rows = [
        [name, f"{statistics.median(s) * 1e6:.2g}", f"{min(s) * 1e6:.2g} to {max(s) * 1e6:.2g}"]
        for name, s in found.items()
    ]
    title = f"CPU per sample, 5 states and 4 controls, in Python; µs, median of {TURNS} interleaved turns, range"
    return table(title, ["monitor", "µs", "range"], rows)


def arrivals(count: int, late: str, seed: int = 0) -> tuple[list[tuple[str, int]], list[int]]:
    """Messages (topic, sample) in order of arrival; one of 20 of `late` comes after the next sample's messages."""
    rng = np.random.default_rng(seed)
    behind = [k for k in range(10, count - 2) if late and rng.random() < 0.05]
    order = [
        (k + 1.5 if topic == late and k in behind else float(k), rank, topic, k)
        for k in range(count)
        for rank, topic in enumerate(("state", "control"))
    ]
    return [(topic, k) for _, _, topic, k in sorted(order)], behind


def gathered(
    z: list[list[float]], t: list[float], n: int, order: Sequence[tuple[str, int]]
) -> dict[float, list[float]]:
    """What SENTIL's node evaluates: values by instant, by the rule of its on_sample."""
    state: dict[str, list[float]] = {}
    pending: set[str] = set()
    stamp, found = -math.inf, {}

    def evaluate() -> None:
        if pending and len(state) == 2:
            found[stamp] = state["state"] + state["control"]
        pending.clear()

    for topic, k in order:
        values = z[k][:n] if topic == "state" else z[k][n:]
        if t[k] < stamp:
            state[topic] = values  # folded into the next sample
            continue
        if t[k] > stamp:
            evaluate()
            stamp = t[k]
        state[topic] = values
        pending.add(topic)
        if len(pending) == 2:
            evaluate()
    return found


def verdicts(model: Any, run: Any, order: Sequence[tuple[str, int]]) -> tuple[dict[float, Any], dict[str, int]]:
    """Violated or not, start of the step and values there, by instant; the counters of the sampler."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.sampling.sampler import Sampler

    states, controls = model.signals.topics[:2]
    sampler, monitor, found = Sampler(model.signals), EnvelopeMonitor(model), {}
    x, u, t_ns = run.x.tolist(), run.u.tolist(), run.t_ns.tolist()
    for arrived, (topic, k) in enumerate(order):
        now = t_ns[0] + arrived * (t_ns[1] - t_ns[0]) // 2
        topic, values = (states, x[k]) if topic == "state" else (controls, u[k])
        for step in sampler.push(topic, now, t_ns[k], values):
            verdict = monitor.judge(step)
            if verdict.judged:
                instant = round((step.t_ns - t_ns[0]) * 1e-9, 6)
                found[instant] = (bool(verdict.violated), round(instant - step.dt, 6), list(step.before))
    return found, dict(sampler.counters)


def late(peers: str) -> str:
    """One of 20 messages of a topic arrives after those of the next sample."""
    from uncertain_lti import fit, read_transients

    runs = read_transients(HEALTHY, ROOT / "config" / "signals" / "turbofan.yaml")
    model = fit(runs)
    (run,) = read_transients(BAGS / "turbofan_levels_noise.mcap", runs[0].signals)
    low, high = recorded_ranges(runs)
    count, n, rows = len(run) - 1, run.x.shape[1], []  # the last control is never judged
    z, t = np.hstack([run.x, run.u]).tolist(), [round(value, 6) for value in run.t.tolist()]
    values_at = dict(zip(t, z, strict=True))

    def robustness(fed: Sequence[tuple[float, list[float]]]) -> tuple[dict[float, float], list[str]]:
        given = [{"t": instant, "z": values} for instant, values in fed]
        answer = asked(peers, {"ask": "values", "rows": given, "low": low, "high": high, "bag": ""})
        return {row["t"]: value for row, value in zip(given, answer["values"], strict=True)}, answer["errors"]

    usual = arrivals(count, "")[0]
    in_order, _ = verdicts(model, run, usual)
    instants = gathered(z, t, n, usual)
    expected, _ = robustness(list(instants.items()))
    for topic in ("control", "state"):
        order, behind = arrivals(count, topic)
        found, counters = verdicts(model, run, order)
        mixed = sum(before != values_at[start] for _, start, before in found.values())
        changed = sum(violated != in_order[i][0] for i, (violated, _, _) in found.items())
        said = ", ".join(f"`{key}` {value}" for key, value in sorted(counters.items()) if value and "late" in key)
        rows.append(
            [f"{topic}, {len(behind)}", "this", str(len(set(in_order) - set(found))), str(mixed), str(changed), said]
        )
        taken = gathered(z, t, n, order)
        values, _ = robustness(list(taken.items()))
        mixed = sum(taken[i] != instants[i] for i in taken)
        changed = sum((values[i] < 0) != (expected[i] < 0) for i in taken)
        rows.append(
            [
                "",
                "SENTIL's node, by its rule",
                str(len(set(instants) - set(taken))),
                str(mixed),
                str(changed),
                "log, once a second",
            ]
        )
        fed, latest = [], {"state": z[0][:n], "control": z[0][n:]}
        for kind, k in order:
            latest[kind] = z[k][:n] if kind == "state" else z[k][n:]
            if kind == "control":  # the second message of an instant, in order
                fed.append((t[k], latest["state"] + latest["control"]))
        values, errors = robustness(fed)
        mixed = sum(v != values_at[i] for i, v in fed if values[i] is not None)
        changed = sum(values[i] is not None and (values[i] < 0) != (expected[i] < 0) for i, _ in fed)
        refused = f"`{errors[0].split(',')[0]}`" if errors else "nothing"
        rows.append(
            [
                "",
                "SENTIL's package, fed with the latest values at every control",
                str(len(errors)),
                str(mixed),
                str(changed),
                refused,
            ]
        )
    title = f"One of 20 messages of a topic arrives after those of the next sample; {count} samples"
    header = ["late topic, messages", "monitor", "instants without a verdict", "judged with values of other instants"]
    header += ["another verdict than in order", "what is reported"]
    return table(title, header, rows)


def to_the_alarm(peers: str) -> str:
    """From bags to the first alarm: what a person runs, CPU, and what is found."""
    from uncertain_lti import read_transients
    from uncertain_lti.cli.main import main as command

    runs = read_transients(HEALTHY, ROOT / "config" / "signals" / "turbofan.yaml")
    low, high = recorded_ranges(runs)
    healthy = ["turbofan_check.mcap"]
    judged_bags = [*healthy, *(f"turbofan_{fault}.mcap" for fault in FAULTS)]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        signals, model = f"{folder}/turbofan.yaml", f"{folder}/turbofan.model.json"
        bags = [str(path) for path in HEALTHY]
        began = time.process_time()
        command(["init", *bags, "--output", signals])
        command(["fit", *bags, "--signals", signals, "--criterion", "lp", "--output", model])
        seconds = time.process_time() - began
        found = {}
        for name in judged_bags:
            text = io.StringIO()
            with contextlib.redirect_stdout(text):
                command(["check", model, str(BAGS / name), "--violations", "2", "--window", "5", "--json"])
            (data,) = json.loads(text.getvalue())["recordings"]
            began_ns = data["verdict_per_sample"][0]["t_ns"]
            found[name] = [
                (v["t_ns"] - began_ns) * 1e-9 for v in data["verdict_per_sample"] if v["alarm"]
            ]  # fmt: skip
    rows = []
    for name in judged_bags:
        (run,) = read_transients(BAGS / name, runs[0].signals)
        answer = asked(
            peers, {"ask": "values", "rows": rows_of(run), "low": low, "high": high, "bag": str(BAGS / name)}
        )
        times = [row["t"] for row, value in zip(rows_of(run), answer["values"], strict=True) if value < 0]
        cells = []
        for alarms in (found[name], times):
            if name in healthy:
                cells.append(f"{len(alarms)} samples" if alarms else "quiet")
            else:
                after, before = [t for t in alarms if t >= ONSET], [t for t in alarms if t < ONSET]
                cells.append(
                    (f"{after[0] - ONSET:.3g} s" if after else "never") + (" (alarm before)" if before else "")
                )
        rows.append([name.removeprefix("turbofan_").removesuffix(".mcap").replace("_", " "), *cells])
    text = table(
        "From the fault to the alarm: two of five verdicts outside, fitted as in the README, and every signal in its "
        "recorded range widened by a hundredth",
        ["bag", "this", "recorded ranges, SENTIL"],
        rows,
    )
    return text + (
        f"\nFrom the bags to a model: two commands, {seconds:.1f} s of CPU. SENTIL's package, asked for a bag: "
        f"`{answer['reads_bag']}`.\n"
    )


PARTS: dict[str, Callable[[str], str]] = {"cost": cost, "late": late, "alarm": to_the_alarm}


def main() -> None:
    """Run the parts that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all of them if none is named")
    parser.add_argument("--peers", default=str(ROOT / ".venv-detection/bin/python"), help="interpreter with SENTIL")
    parser.add_argument("--write", type=Path, help="page whose tables are replaced")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer:
        print(json.dumps(peer(json.load(sys.stdin))))
        return
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    for part in options.parts or PARTS:
        text = PARTS[part](options.peers)
        print(text)
        if options.write:
            mark, page = f"<!-- temporal logic {part} -->", options.write.read_text()
            before, _, rest = page.partition(mark)
            options.write.write_text(f"{before}{mark}\n\n{text}\n{mark}{rest.partition(mark)[2]}")


if __name__ == "__main__":
    main()
