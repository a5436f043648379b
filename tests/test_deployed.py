# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The rule of a deployment, tried on a recording: the alarm that the live session raises on the same messages."""

import json

import numpy as np
import perturbed
import pytest
from bag_writer import Message, Topic, float64, joint_state, write
from perturbed import GEAR as MODE

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.monitor.alarm import Arming, Condition
from uncertain_lti.monitor.deployed import DeployedMonitor
from uncertain_lti.monitor.session import Rule
from uncertain_lti.plants.leibov import CONTROL_TOPIC as CONTROL
from uncertain_lti.plants.leibov import STATE_TOPIC as STATE
from uncertain_lti.plants.leibov import transient
from uncertain_lti.sampling.clock import Status

SIGNALS = f"""
states:
  - {{name: fan, topic: {STATE}, field: "position[fan_speed]"}}
  - {{name: core, topic: {STATE}, field: "position[compressor_speed]"}}
  - {{name: hot, topic: /engine/hot, field: "position[temperature]"}}
controls:
  - {{name: fuel, topic: {CONTROL}, field: "position[main_fuel_flow]"}}
  - {{name: area, topic: {CONTROL}, field: "position[nozzle_throat_area]"}}
"""
JOINT_STATE = "sensor_msgs/msg/JointState"
TOPICS = [Topic(MODE, "std_msgs/msg/Float64"), *(Topic(name, JOINT_STATE) for name in ("/engine/hot", STATE, CONTROL))]


def messages_of(plant, modes=(), names=None):
    """A run of the engine, with modes {sample: values} that come just before that sample's state."""
    messages, hot = [], plant.state_names.index("turbine_exit_total_temperature")
    for k, t in enumerate(plant.t_ns.tolist()):
        messages += [Message(MODE, t - 1, float64(value), t - 1) for value in dict(modes).get(k, ())]
        messages.append(Message("/engine/hot", t, joint_state(t, plant.x[k, [hot]], ["temperature"]), t))
        state = joint_state(t, plant.x[k], plant.state_names) if names is None else names(k, t)
        messages += [Message(STATE, t, state, t)]
        messages.append(Message(CONTROL, t, joint_state(t, plant.u[k], plant.control_names), t))
    return messages


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    """A model, its folder, and the messages of a recording with a fault and changing modes; states on two topics."""
    folder = tmp_path_factory.mktemp("deployed")
    (folder / "signals.yaml").write_text(SIGNALS)
    write(TOPICS, messages_of(transient(300, 1, start_ns=10**18))).save(folder / "healthy.mcap")
    modes = {20: [3], 100: [1], 130: [3], 190: [1, 3], 220: [1], 221: [3]}
    messages = messages_of(transient(300, 2, start_ns=10**18, fault_at=60), modes)
    write(TOPICS, messages).save(folder / "run.mcap")
    model = fit(read_transients(folder / "healthy.mcap", folder / "signals.yaml"))
    model = model.replace(alarm_rule=AlarmRule(2, 5))
    model.save(folder / "m.model.json")
    return model, folder, messages


def alarms_of(data):
    return [(v["t_ns"], v["alarm"]) for v in data["recordings"][0]["verdict_per_sample"]]


def live(model, messages, rule):
    """Instants that the session judges, and whether it has an alarm."""
    return [(row["t_ns"], row["alarm"]) for row in perturbed.live(perturbed.session_of(model, rule), messages)]


@pytest.mark.parametrize(
    "options",
    [
        {"masked": "fan, hot"},
        {"enable": f"{MODE} data == 3", "grace": 0.4},
        {"enable": f"{STATE} position[fan_speed] > 0.01", "latch": True},
    ],
)
def test_a_recording_is_judged_as_the_session_judges_its_messages(machine, options, cli):
    model, folder, messages = machine
    expected = live(model, messages, Rule(**options))
    words = [w for k, v in options.items() for w in ([f"--{k}"] if v is True else [f"--{k}", str(v)])]
    raised = [alarm for _, alarm in expected]
    data = cli.json("check", folder / "m.model.json", folder / "run.mcap", *words, status=1)
    assert alarms_of(data) == expected and 0 < sum(raised) < len(raised)
    report = cli.json("report", folder / "m.model.json", folder / "run.mcap", *words, status=1)
    assert report["recordings"][0]["alarms"] == data["recordings"][0]["alarms"]
    assert report["rule"]["conditions"] == data["deployed"]


@pytest.mark.parametrize("enable", ["", f"{STATE} position[fan_speed] > 0.01", f"{STATE} position[gripper] > 0.5"])
def test_messages_of_another_publisher_with_other_names_do_not_count(machine, enable, tmp_path, cli):
    """A gripper on the topic of the joints, in turn with them, first and last."""
    model, folder, messages = machine
    rng, mixed = np.random.default_rng(2), []
    for message in messages:
        mixed += [message] if message.topic != STATE or mixed else []
        t = message.log_time + int(rng.integers(0, 20_000_000))
        mixed.append(Message(STATE, message.log_time, joint_state(t, [float(len(mixed) > 200)], ["gripper"]), t))
    path = write(TOPICS, mixed).save(tmp_path / "two.mcap")
    expected = live(model, mixed, Rule(enable=enable))
    assert "gripper" in enable or expected == live(model, messages, Rule(enable=enable))
    assert 0 < sum(alarm for _, alarm in expected) < len(expected) > 290
    assert alarms_of(cli.json("check", folder / "m.model.json", path, "--enable", enable, status=1)) == expected


@pytest.mark.parametrize("whole_model", [True, False])
def test_rules_of_a_file_are_judged_by_as_if_they_were_the_model_s(machine, whole_model, tmp_path, cli):
    model, folder, _ = machine
    other = model.replace(alarm=[AlarmRule(3, 4, 1.5), StatisticRule("energy", 0.5, 0.3)])
    other.save(tmp_path / "other.model.json")
    if whole_model:
        given = tmp_path / "other.model.json"
    else:
        given = tmp_path / "rules.json"
        given.write_text(json.dumps({"rules": [rule.to_dict() for rule in other.alarm]}))
    mine, run = folder / "m.model.json", folder / "run.mcap"
    before, words = mine.read_bytes(), ([tmp_path / "other.model.json"], [mine, "--rules", given], [mine])
    said = [cli.json("check", model, run, *more, status=1)["recordings"] for model, *more in words]
    assert said[0] == said[1] != said[2]
    assert mine.read_bytes() == before
    report = cli.json("report", mine, run, "--rules", given, status=1)
    assert report["recordings"][0]["alarms"] == said[0][0]["alarms"]


def test_from_and_to_judge_that_time_alone(machine, cli):
    model, folder, _ = machine
    name = [str(folder / "m.model.json"), str(folder / "run.mcap")]
    (run,) = read_transients(folder / "run.mcap", model.signals)
    whole = EnvelopeMonitor(model).check(run)
    data = cli.json("check", *name, "--from", 1.0, "--to", 1.5, status=3)["recordings"][0]  # outside the fitted domain
    inside = (run.t >= 1.0) & (run.t <= 1.5)
    first = int(np.flatnonzero(inside)[0])
    assert data["verdicts"] == inside.sum() - 1
    assert f"{(~inside).sum()} {Status.UNASKED.value}" in data["no_verdict"]
    rows = zip(data["verdict_per_sample"], inside, strict=True)
    assert all(v["flags"] == [None] * 3 for v, there in rows if not there)
    k = first + 5
    assert data["verdict_per_sample"][k]["lower"] == whole.lower[k].tolist()  # the time of a row stays its own
    assert data["verdict_per_sample"][k]["t_ns"] == run.t_ns[k]
    said = cli("check", *name, "--from", "3.0", status=1).out
    assert "from 3 s" in said and "first at" in said
    first_alarm = float(said.split("first at ")[1].split()[0])
    assert first_alarm >= 3.0


@pytest.mark.parametrize("values", [[0.0, 1.0], [1.0, 0.0]])
def test_from_a_time_on_the_condition_is_the_last_that_was_heard(values):
    """As if the node were started then, with the condition known; the last sample is the one at the end asked for."""
    none = np.empty((1, 0))
    monitor = EnvelopeMonitor(UncertainLTI([[0.0]], none, [[0.0]], none, v=[0.1]))
    deployed = DeployedMonitor(monitor, Condition.parse("/mode data == 1"), start=3.0, stop=5.0)
    verdicts = deployed.check(Transient(np.arange(7.0), np.arange(7.0), []), [1, 2], values)
    assert verdicts.judged.tolist() == [False] * 4 + [True] * 2 + [False]
    assert verdicts.alarm.tolist() == [False] * 4 + [values[-1] == 1.0] * 2 + [False]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--masked", "nobody"], "masked state 'nobody' is not in the model"),
        (["--masked", ","], "masked is ',', which names no state"),
        (["--write", "out.csv"], "out.csv: is neither a folder nor called *.mcap"),
        (["--enable", f"{STATE} position[fan_speed] > nan"], "write TOPIC FIELD OPERATOR NUMBER"),
        (["--enable", "mode is 3"], "write TOPIC FIELD OPERATOR NUMBER"),
        (["--enable", "/nowhere data == 3"], "there is no topic /nowhere"),
        (["--enable", f"{STATE} position[fan_sped] > 1"], "there is no 'fan_sped' in the message's names"),
        (["--grace", "nan"], "grace is nan"),
        (["--from", "5", "--to", "4"], "leaves nothing to judge"),
        (["--from", "1e6"], "no sample lies between"),
        (["--rules", "nowhere.json"], "nowhere.json: there is no such"),
        (["--rules", "empty.json"], "empty.json: no rules of an alarm; give a model file"),
        (["--rules", "far.json"], "far.json: does not fit the model: "),
        (["--rules", "turned.json"], "turned.json: its thresholds are of the states "),
        (["--from", "nan"], "from is nan; give seconds after the first sample"),
        (["--rules", "odd.json"], "odd.json: field 'alarm.rules[0].kind' is 'median'"),
    ],
)
def test_what_cannot_be_deployed_is_refused(machine, options, words, cli, tmp_path, monkeypatch):
    model, folder, _ = machine
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.json").write_text("[]")
    model.replace(alarm=[StatisticRule("energy", 0.5, (1.0,) * model.n)]).save("turned.json")
    turned = json.loads((tmp_path / "turned.json").read_text())
    (tmp_path / "turned.json").write_text(json.dumps(turned | {"states": turned["states"][::-1]}))
    (tmp_path / "odd.json").write_text('{"rules": [{"kind": "median", "window_s": 1.0, "threshold": 1.0}]}')
    far = {"kind": "mean", "window_s": 1.0, "threshold": 1.0, "horizon": 50}
    (tmp_path / "far.json").write_text(json.dumps({"rules": [far]}))
    said = cli("check", folder / "m.model.json", folder / "run.mcap", *options, status=2).err
    assert words in said and said.count("\n") == 1, said


def test_a_looped_recording_starts_the_grace_over():
    """Of arrays: in each pass the alarm may count again after the grace, from the pass's second sample on."""
    t_ns = np.array([0, 1, 2, 3, 0, 1, 2, 3], dtype=np.int64) * 10**9
    armed = Arming(None, 2 * 10**9).over(t_ns)
    assert armed.counts.tolist() == [False, False, True, True, True, False, True, True]
    assert armed.cleared.tolist() == [True, True, False, False, False, True, False, False]
    condition = Condition.parse("/mode data == 1")
    armed = Arming(condition, 0).over(t_ns[:4], [1, 3, 3], [1.0, 0.0, 1.0])
    assert armed.counts.tolist() == [False, True, True, True]
    assert armed.cleared.tolist() == [True, False, False, True]  # it went off and on between two samples


def test_of_a_name_that_is_there_twice_the_first_counts_live_and_offline(machine, tmp_path, cli):
    """With names that move from one message to the next, and a condition on another topic."""
    model, folder, _ = machine
    rng, plant, first = np.random.default_rng(1), transient(200, 2, start_ns=10**18), []
    n = len(plant.state_names)

    def moving(k, t):
        order = rng.permutation([*range(n), *rng.integers(0, n, 2)])
        x = plant.x[k][order] + 1e-4 * np.arange(n + 2)  # of places, not of names
        first.append(x[order.tolist().index(plant.state_names.index("fan_speed"))])
        return joint_state(t, x, [plant.state_names[i] for i in order])

    messages = messages_of(plant, {0: [3]}, moving)
    path = write(TOPICS, messages).save(tmp_path / "twice.mcap")
    condition = f"{MODE} data > 1"
    data = cli.json("check", folder / "m.model.json", path, "--enable", condition, status=1)
    assert alarms_of(data) == live(model, messages, Rule(enable=condition))
    read = read_transients([path], folder / "signals.yaml")[0]
    assert read.x[:, 0].tolist() == first[: len(read)]
