# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`uncertain-lti start` does what `init`, `fit` and `report` do one after another."""

import numpy as np
import pytest
from bag_writer import Message, Topic, write
from engine_bag import engine_bag

from uncertain_lti import UncertainLTI
from uncertain_lti.cli.main import main
from uncertain_lti.plants.leibov import STATE_TOPIC
from uncertain_lti.proposal.init import propose
from uncertain_lti.recordings.bag import Bag


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in (1, 2, 3):
        engine_bag(tmp_path / f"healthy_{seed}.mcap", seed=seed)
    engine_bag(tmp_path / "damaged.mcap", seed=4, change=lambda k, x: x * (1 + k % 2 * (k > 200)))
    return tmp_path


HEALTHY = [f"healthy_{seed}.mcap" for seed in (1, 2, 3)]


def test_start_gives_the_files_of_the_three_commands(folder, cli):
    printed = cli("start", *HEALTHY, "--check", "damaged.mcap", status=1).out
    assert "The alarm was raised" in printed and (folder / "machine.html").as_uri() in printed
    assert printed.splitlines()[-3:] == [
        "  scp machine.model.json ROBOT:",
        "  envelope_monitor --ros-args -p model:=machine.model.json",
        "  ros2 topic echo /envelope_monitor/violation",
    ]
    assert main(["init", *HEALTHY, "--output", "alone.yaml"]) == 0
    assert main(["fit", *HEALTHY, "--signals", "alone.yaml", "--output", "alone.model.json"]) == 0
    assert (folder / "machine.yaml").read_text() == (folder / "alone.yaml").read_text()
    ours, alone = (UncertainLTI.load(f"{name}.model.json") for name in ("machine", "alone"))
    assert np.array_equal(ours.A, alone.A) and np.array_equal(ours.dA, alone.dA) and ours.alarm == alone.alarm
    assert (folder / "machine.html").read_text().lstrip().lower().startswith("<!doctype html")


def test_a_model_that_is_not_worth_having_is_not_sent_to_the_robot(folder, capsys):
    switch = np.random.default_rng(1).uniform(0, 1, (1000, 5))
    engine_bag(folder / "rare.mcap", change=lambda k, x: switch[k // 10])
    assert main(["start", "rare.mcap", "--output", "rare"]) in (0, 3)
    printed = capsys.readouterr().out
    assert "may I rely on it? no" in printed and "ROBOT" not in printed
    assert printed.splitlines()[-1].startswith("not on the robot yet: mend what is said above, in rare.yaml or by")


def test_of_a_table_nothing_is_sent_to_a_robot(folder, cli, capsys):
    """The command that was advised ends with an error there: a table is no topic."""
    t = 0.02 * np.arange(3000)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=60), 50)
    x = np.zeros(3000)
    for k in range(2999):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k] + 0.001 * rng.normal()
    np.savetxt("a.csv", np.column_stack([t, x, u]), delimiter=",", header="time,speed,speed_cmd", comments="")
    assert main(["start", "a.csv", "--output", "a.model.json"]) in (0, 1, 3)  # the name of one of its files
    printed = capsys.readouterr().out
    assert "ROBOT" not in printed and "no publisher sends a table" in printed.splitlines()[-1]
    again = cli("fit", "a.csv", "--signals", "a.yaml", "--output", "b.model.json").out
    assert "next:" in again and "envelope_monitor" not in again


def test_a_name_that_begins_as_an_option_does_is_handed_on(folder, cli):
    (folder / HEALTHY[0]).rename("-run.mcap")
    printed = cli("init", "--output=-s.yaml", "--", "-run.mcap").out
    assert "  uncertain-lti fit ./-run.mcap --signals ./-s.yaml" in printed
    assert cli("start", "--output=-s", "--quiet", "--", "-run.mcap").out == "" and (folder / "-s.html").exists()


def test_an_edited_signals_file_is_used_as_it_is(folder, cli):
    assert cli("start", *HEALTHY, "--output", "m", "--quiet").out == ""
    text = (folder / "m.yaml").read_text()
    (folder / "m.yaml").write_text(text.replace("name: fan_speed", "name: fan"))
    assert "write over it with --force" in cli("start", *HEALTHY, "--output", "m", status=2).err
    assert "is none; leave it out" in cli("init", *HEALTHY, "--table", "time=t", status=2).err
    assert "m.yaml is there" in cli("start", *HEALTHY, "--output", "m", "--force", "--table", "step=1", status=2).err
    data = cli.json("start", *HEALTHY, "--output", "m", "--force")
    assert "init" not in data and data["exit_status"] == 0 and not data["findings"]["alarm"]
    assert "fan" in UncertainLTI.load("m.model.json").state_names
    assert data["fit"]["fit"]["transitions"] == 3 * 299 and data["report"] == "m.html"


def test_what_is_not_used_of_a_recording_is_said_as_fit_says_it(folder, cli):
    """Also where the signals file is there already, so that `init` does not read the recordings."""
    messages = [Message(raw.topic, raw.log_time_ns, raw.data) for raw in Bag(folder / HEALTHY[1]).raw_messages()]
    of_state = next(m for m in messages[100:] if m.topic == STATE_TOPIC)
    topics = [Topic(topic, "sensor_msgs/msg/JointState") for topic in dict.fromkeys(m.topic for m in messages)]
    write(topics, sorted([*messages, of_state], key=lambda m: m.log_time)).save(folder / HEALTHY[1])
    whole = (folder / HEALTHY[0]).read_bytes()
    (folder / HEALTHY[0]).write_bytes(whole[: len(whole) * 9 // 10])
    said = cli("start", *HEALTHY)
    again = cli("start", *HEALTHY, "--force")
    for one in (said, again):
        assert f"{HEALTHY[1]}: " in one.out and "1 dropped (equal stamp))" in one.out
        assert f"{HEALTHY[2]}: " not in one.out.partition("may I rely")[0]
        assert one.err.count(f"{HEALTHY[0]}: cut after ") == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fit", "a\udcffb.mcap", "--signals", "s.yaml", "--output", "m"], r"a\udcffb.mcap: this name is not UTF-8"),
        (["tune", "a\udcffb.mcap", "--signals", "s.yaml", "--output", "m"], r"a\udcffb.mcap: this name is not UTF-8"),
        (["init", *HEALTHY, "--output", "no_such_folder/s.yaml"], "the folder no_such_folder is not there; make it"),
        (["watch", "--outptu", "m"], "unrecognized arguments: --outptu\n"),
    ],
)
def test_what_cannot_be_written_is_found_before_the_work(folder, capsys, monkeypatch, words, sentence):
    def work(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr("uncertain_lti.proposal.init.propose", work)
    monkeypatch.setattr("uncertain_lti.sampling.reading.read_transients", work)
    monkeypatch.setattr("uncertain_lti.read_transients", work, raising=False)
    try:
        assert main(words) == 2
    except SystemExit as end:
        assert end.code == 2
    assert sentence in capsys.readouterr().err


def test_a_signals_file_that_comes_meanwhile_is_not_replaced(folder, capsys, monkeypatch):
    """Of two that were started at once, one wrote over the other's signals file and model."""

    def proposed_late(*words, **more):
        (folder / "m.yaml").write_text("of another")
        return propose(*words, **more)

    monkeypatch.setattr("uncertain_lti.proposal.init.propose", proposed_late)
    assert main(["start", *HEALTHY, "--output", "m"]) == 2
    assert "m.yaml: came while this ran; choose another output, or move it away" in capsys.readouterr().err
    assert (folder / "m.yaml").read_text() == "of another" and not list(folder.glob("*m.model.json"))
