# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The commands: what they print, what they return, and one sentence for bad input."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bag_writer import Message, Topic, metadata_yaml, ramp, write, write_folder
from engine_bag import SIGNALS, engine_bag

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.progress import Progress
from uncertain_lti.cli.main import build_parser, main
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.plants.leibov import STATE_TOPIC
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.findings import findings, overview


def refused(cli, *words):
    """Status 2 and one sentence on standard error, no traceback, nothing on standard output."""
    said = cli(*words, status=2)
    assert said.err.count("\n") == 1 and "Traceback" not in said.err, said.err
    return said.err


def test_check_tells_when_and_how_long(folder, cli):
    """A sensor that jumps for three samples: two transitions of the jump and nothing else."""
    bad = folder / "bad.mcap"
    (result,) = cli.json("check", folder / "m.model.json", bad, status=1)["recordings"]
    fan = result["states"]["fan"]
    assert fan["first_violation"]["k"] == 100 and fan["first_violation"]["t"] == pytest.approx(2.5)
    assert fan["first_violation"]["t_ns"] == 10**18 + 2_500_000_000
    flags = np.array([s["flags"] for s in result["verdict_per_sample"]], dtype=float)
    assert np.isnan(flags[0]).all() and flags.shape == (300, 2)
    assert flags[100, 0] == 1 and flags[103, 0] == 1 and np.nansum(flags[:100]) == 0
    assert fan["violations"] == np.nansum(flags[:, 0])
    assert result["alarm"] and result["alarms"][0]["k"] == 100
    assert "ALARM" in cli("check", folder / "m.model.json", bad, status=1).out
    # an alarm rule of the command line in place of the model's: 250 of 250 never comes true
    rule = ["--violations", "250", "--window", "250"]
    assert main(["check", str(folder / "m.model.json"), str(bad), *rule]) == 0


def test_check_ends_with_how_to_take_a_healthy_recording_into_the_model(folder, tmp_path, cli):
    model = shutil.copy(folder / "m.model.json", tmp_path / "m.model.json")
    last = cli("check", model, folder / "bad.mcap", status=1).out.splitlines()[-1]
    said, _, command = last.partition("uncertain-lti ")
    assert said == "if the machine was healthy: "
    whole = Bag(folder / "bad.mcap")
    every = [Message(m.topic, m.log_time_ns, m.data, m.log_time_ns) for m in whole.raw_messages()]
    topics = [Topic(name, info.type) for name, info in whole.topics.items()]
    parts = [
        str(write(topics, some).save(tmp_path / f"run_{i}.mcap")) for i, some in enumerate((every[:300], every[300:]))
    ]
    in_parts = cli("check", model, *parts, status=1).out.splitlines()[-1]
    assert shlex.split(in_parts)[-3:] == ["--force", *parts], "of one recording"
    cli(*shlex.split(command))
    assert "healthy" not in cli("check", model, folder / "bad.mcap").out
    UncertainLTI.load(model).replace(memory=None).save(model)
    assert "healthy" not in cli("check", model, folder / "bad.mcap", "--margin", "0.5", status=1).out, (
        "it keeps nothing"
    )


@pytest.mark.parametrize("after", [1, 6])
def test_an_alarm_lasts_no_longer_than_the_pass_that_raised_it(after):
    """A loop begins anew, with as many samples after it."""
    empty = np.empty((1, 0))
    model = UncertainLTI([[0.0]], empty, [[0.0]], empty, v=[1.0])
    t, x = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 0.0, 0.0, 9.0, 18.0, 27.0]
    run = Transient(np.array([*t, *t[:after]]), [*x, *x[:after]], [], max_gap=1.5)
    data = check_data(model, EnvelopeMonitor(model).check(run))
    assert (data["alarms"][0]["t"], data["alarms"][0]["seconds"]) == (3.0, 2.0)
    assert data["seconds"] == 5.0 + after - 1.0


def test_commands_say_what_the_library_says(folder, capsys):
    """Several recordings are separate transients."""
    from uncertain_lti import fit, read_transients

    bags = (folder / "run.mcap", engine_bag(folder / "second.mcap", steps=120, seed=2))
    transients = read_transients(bags, folder / "signals.yaml")
    model, path = fit(transients, additive="noise"), folder / "both.model.json"
    words = ["--signals", str(folder / "signals.yaml"), "--output", str(path), "--additive", "noise", "--json"]
    assert main(["fit", *map(str, bags), *words]) == 0
    same = UncertainLTI.load(path)
    assert json.loads(capsys.readouterr().out)["fit"] == same.to_dict()["fit"]
    assert np.array_equal(same.A, model.A) and np.array_equal(same.dB, model.dB)
    facts = same.fit_summary
    assert (facts["transients"], facts["transitions"], facts["violations"]) == (2, 299 + 119, 0)
    assert [Path(source["file"]) for source in facts["sources"]] == list(bags)
    assert all(len(source["sha256"]) == 64 for source in facts["sources"])
    assert same.signals.clock == STATE_TOPIC and same.signals.states[0].type == "sensor_msgs/msg/JointState"
    assert main(["check", str(path), *map(str, bags), "--json"]) == 0
    for result, run in zip(json.loads(capsys.readouterr().out)["recordings"], transients, strict=True):
        verdicts = EnvelopeMonitor(model).check(run)
        for k, said in enumerate(result["verdict_per_sample"][1:], start=1):
            assert said["lower"] == verdicts.lower[k].tolist() and said["flags"] == verdicts.flags[k].tolist()


# --- bad input ---


WRONG_SIGNALS = {
    "another_topic": (("/engine/state", "/engine/stat"), "topics there: /engine/control, /engine/state"),
    "near_topic": (("/engine/state", "/engine/stte", 1), "/engine/stte (is /engine/state meant?)"),
    "near_field": (("position[fan_speed]", "positon[0]"), "(is position meant?)"),
    "near_name": (("position[fan_speed]", "position[fan_sped]"), "(is fan_speed meant?)"),
    "near_function": (("position[fan_speed]", "rol(position[0])"), "no function 'rol' (is roll meant?)"),
    "near_key": (("states:", "sates:"), "unknown key 'sates' (is states meant?)"),
    "no_yaml": (("states:", "states: [1, 2"), "is not YAML"),
}
FIT = "fit run.mcap --signals signals.yaml --output new.model.json"
WRITERS = (
    "fit run.mcap --signals signals.yaml --additive noise --output", "validate m.model.json --output",
    "report m.model.json run.mcap --output", "layout m.model.json --foxglove", "layout m.model.json --plotjuggler",
)  # fmt: skip
VICTIMS = ("run.mcap", "signals.yaml", "lfs.mcap")
REFUSED = [
    *((f"fit run.mcap --signals {n}.yaml --output new", words) for n, (_, words) in WRONG_SIGNALS.items()),
    ("check none.model.json run.mcap", "no such model file"),
    ("check signals.yaml run.mcap", "this is a signals file, and a model file is wanted here; write a"),
    ("check text.mcap run.mcap", "is not JSON"),
    ("check . run.mcap", "this is a folder, and a model file is wanted here; name the file in it"),
    ("check leibov206 run.mcap", "(is leibov2006 meant?)"),
    ("check run.mcap m.model.json", "an MCAP recording, and a model file is wanted here; are the arguments swapped?"),
    ("topics text.mcap", "text.mcap"),
    ("check table.csv m.model.json", "this is a table, and a model file is wanted here; are the arguments swapped?"),
    ("topics signals.yaml", "a signals file, and a recording is wanted here; are the arguments swapped?"),
    (FIT.replace("run", "nope"), "nope.mcap"),
    (FIT.replace("run", "empty"), "empty"),
    (FIT.replace("run", "lfs"), "git lfs pull"),
    (FIT.replace("signals.yaml", "nope.yaml"), "nope.yaml"),
    (FIT.replace("new", "no/m"), "make it first"),
    (FIT.replace("new.model.json", "parts"), "parts: is a folder; name a file in it, for example"),
    (f"{FIT} --workers 0", "--workers is 0; give 1 or more"),
    (f"{FIT} --schedule fam", "is fan meant"),
    (f"{FIT} --schedule fan --schedule fan=3", "twice"),
    (f"{FIT} --schedule fan=0", "at least 1"),
    (f"{FIT} --schedule fan=auto --cache arrays", "auto"),
    (f"{FIT} --update m.model.json --criterion qp", "--signals is given, and an update keeps what"),
    (
        "fit run.mcap --update m.model.json --criterion qp --output new",
        "--criterion is given, and an update keeps what",
    ),
    ("fit run.mcap --output new", "no --signals; give the signals file"),
    # a place that cannot be written is refused before the work: what is read first is not there, or would print
    *((f"{words} absent.mcap --output /sys/x", "/sys/x") for words in ("init", "start", "fit --signals absent.yaml")),
    ("check leibov2006 run.mcap --write /sys/x.mcap", "/sys/x.mcap: cannot be written"),
    *((f"{command} leibov2006 run.mcap --output /sys/x.html", "/sys/x.html") for command in ("report", "plot")),
    ("layout leibov2006 --foxglove /sys/x.json", "/sys/x.json"),
    ("reproduce --output text.mcap", "cannot be written"),
    # nothing but an older file of its kind is written over, whatever the option was meant to be
    *((f"{words} {name}", "choose another name") for words in WRITERS for name in VICTIMS),
    ("check m.model.json bad.mcap --write bad.mcap", "is the recording itself"),
    ("check m.model.json bad.mcap --write link.mcap", "is the recording itself"),
    ("check m.model.json bad.mcap --write text.mcap", "is there already"),
    ("check m.model.json bad.mcap --write no/out.mcap", "make it first"),
    ("check m.model.json bad.mcap run.mcap --write x.mcap", "one file for 2 recordings"),
    ("check m.model.json parts --write parts/x.mcap", "folder of the recording"),
    ("check m.model.json bad.mcap --write m.model.json", "neither a folder nor"),
    ("plot m.model.json --output m.html", "model alone is drawn as an image"),
    ("plot run.mcap --output r.png", "without a model are drawn as a page"),
    ("plot m.model.json run.mcap bad.mcap --output r.png", "an image shows one recording"),
    ("plot m.model.json run.mcap --output r.gif", "end the name in .html, .png"),
    ("plot m.model.json run.mcap --signals s.yaml", "the model has its signals"),
    ("plot m.model.json run.mcap --output run.mcap", "end the name in"),
    ("plot no.model.json run.mcap --output r.html", "no such"),
    ("report leibov2006 run.mcap --output r.pdf", "r.pdf: a report is a page; end the name in .html"),
    ("plot no.mcap --output r.html", "no such"),
    ("plot m.model.json run.mcap --output no/r.html", "make it first"),
    ("layout m.model.json", "--foxglove"),
    ("layout m.model.json --foxglove no/x.json", "make it first"),
    ("validate m.model.json run.mcap bad.mcap", "do not give this model again (not as fitted: bad.mcap), so"),
    ("validate m.model.json absent.mcap --false-alarms -1", "give a positive number per hour"),
    ("validate m.model.json --within 0", "positive number of seconds"),
    ("validate m.model.json --output no/m.json", "make it first"),
    ("signature m.model.json fan_damage --output new", "LABEL=BAG"),
    ("signature m.model.json x=run.mcap --output new", "no alarm was raised"),
    ("start absent.mcap", "absent.mcap"),
    ("start run.mcap --check absent.mcap", "absent.mcap"),
    ("start a\udcffb.mcap", "this name is not UTF-8, and a model file names its recordings; rename it"),
    ("start run.mcap --output models/", "names no file"),
    ("start run.mcap --output no_such_folder/m", "no_such_folder"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_bad_input_gets_one_sentence_and_changes_nothing(folder, words, said, monkeypatch, cli):
    for name, ((old, new, *count), _) in WRONG_SIGNALS.items():
        (folder / f"{name}.yaml").write_text(SIGNALS.replace(old, new, *count))
    (folder / "empty.mcap").write_bytes(b"")
    (folder / "lfs.mcap").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    (folder / "text.mcap").write_text("not a bag")
    (folder / "table.csv").write_text("time,x\n0,1\n1,2\n")
    (folder / "link.mcap").symlink_to(folder / "bad.mcap")
    parts = {f"bag_{i}.mcap": write([Topic("/a")], ramp("/a", range(i * 10, i * 10 + 10))) for i in range(2)}
    write_folder(folder / "parts", parts, metadata_yaml(parts))
    monkeypatch.chdir(folder)
    before = {path: path.is_file() and path.read_bytes() for path in sorted(folder.rglob("*"))}
    assert said in refused(cli, *words.split())
    assert {path: path.is_file() and path.read_bytes() for path in sorted(folder.rglob("*"))} == before


def test_a_condition_that_cannot_hold_is_no_quiet(folder, tmp_path, cli):
    """An alarm that is never armed says nothing of the machine."""
    model, run = str(folder / "m.model.json"), folder / "run.mcap"
    for words in (["--enable", f"{STATE_TOPIC} position[fan_speed] > 1e9"], ["--grace", "1000"]):
        assert "UNKNOWN: the alarm was armed at no verdict" in cli("check", model, run, *words, status=3).out
    assert main(["check", model, str(run), "--enable", f"{STATE_TOPIC} position[fan_speed] < 1e9"]) == 0
    silent = engine_bag(tmp_path / "silent.mcap", more=[Topic("/engine/mode")])
    said = refused(cli, "check", model, silent, "--enable", "/engine/mode data == 3")
    assert "/engine/mode has no message" in said


def test_an_older_page_or_layout_is_written_over(folder, cli):
    model = folder / "m.model.json"
    pages = [["report", model, folder / "run.mcap", "--output", folder / "page.html", "-q"]]
    pages += [["layout", model, f"--{kind}", folder / kind] for kind in ("foxglove", "plotjuggler")]
    for words in [*pages, *pages]:
        cli(*words)


def test_a_recording_of_one_robot_of_several_is_checked_below_its_prefix(folder, tmp_path, cli):
    """As the node hears it with `topic_prefix`; the condition, too, is below it."""
    plain, robot = Bag(folder / "bad.mcap"), tmp_path / "robot.mcap"
    topics = [Topic(f"/robot1{topic}", info.type) for topic, info in plain.topics.items()]
    messages = [Message(f"/robot1{m.topic}", m.log_time_ns, bytes(m.data)) for m in plain.raw_messages()]
    write(topics, messages).save(robot)
    enable = ["--enable", f"{STATE_TOPIC} position[fan_speed] > -100"]

    def judged(*arguments):
        (result,) = cli.json("check", folder / "m.model.json", *arguments, *enable, status=1)["recordings"]
        return result["verdict_per_sample"], result["alarms"]

    for prefix in ("/robot1", "robot1/"):
        assert judged(robot, "--topic-prefix", prefix) == judged(folder / "bad.mcap")
    said = refused(cli, "check", folder / "m.model.json", robot)
    assert "is /robot1/engine/state meant?" in said and "with --remap /engine/state:=NAME" in said
    table = tmp_path / "table.csv"
    table.write_text("t,x\n" + "".join(f"{k},{k}\n" for k in range(9)))
    assert "/engine/state; topics there: /table\n" in refused(cli, "check", folder / "m.model.json", table), (
        "no name would help"
    )


def test_a_recording_of_remapped_topics_is_checked_by_their_names_there(folder, tmp_path, cli):
    """As the node hears it with `-r`, which acts below `topic_prefix`; a check could not be told so."""
    plain, robot, name = Bag(folder / "bad.mcap"), tmp_path / "robot.mcap", {STATE_TOPIC: "/drives/all"}
    topics = [Topic(name.get(topic, f"/r{topic}"), info.type) for topic, info in plain.topics.items()]
    messages = [Message(name.get(m.topic, f"/r{m.topic}"), m.log_time_ns, bytes(m.data)) for m in plain.raw_messages()]
    write(topics, messages).save(robot)
    words, model = ["--enable", f"{STATE_TOPIC} position[fan_speed] > -100"], folder / "m.model.json"
    moved = [*words, "--topic-prefix", "r", "--remap", f"/r{STATE_TOPIC}:=drives/all"]
    (one,) = cli.json("check", model, robot, *moved, status=1)["recordings"]
    (other,) = cli.json("check", model, folder / "bad.mcap", *words, status=1)["recordings"]
    assert one["verdict_per_sample"] == other["verdict_per_sample"] and one["alarms"] == other["alarms"]
    assert "--remap /x: it is not read; what is read is" in refused(cli, "check", model, robot, "--remap", "x:=y")


def test_a_recording_without_topics_is_told_as_such(tmp_path, cli):
    """A table of no rows was all that was printed."""
    path = write([], []).save(tmp_path / "none.mcap")
    assert cli("topics", path).out == f"{path}: there is no topic in it\n"


def test_help_and_usage(capsys):
    """Every command has --help; wrong usage is status 2."""
    for words, status in (
        *(([*name, "--help"], 0) for name in ([], ["fit"], ["play"])),
        *((wrong, 2) for wrong in (["fit"], ["nonsense"], ["check", "a", "b", "--margin", "x"])),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        assert stopped.value.code == status and "usage" in "".join(capsys.readouterr())


def test_quiet_outside_the_fitted_domain_is_no_quiet(folder, cli):
    """Inside all bounds, and most of it where nothing vouches for them: said loudly, and in the JSON by a word."""
    path = folder / "m.model.json"
    model = json.loads(path.read_text())
    printed = cli.json("check", path, folder / "run.mcap")
    assert (printed["outcome"], printed["exit_status"]) == ("quiet", 0)
    middle = np.median([s["state"][0] for s in printed["recordings"][0]["verdict_per_sample"]])
    model["domain"]["x_max"][0] = float(middle)  # half of what was seen is now beyond what was fitted
    path.write_text(json.dumps(model))
    first, *_, last, take_in = cli("check", path, folder / "run.mcap", status=3).out.splitlines()
    assert first.startswith("UNKNOWN: 4")
    assert take_in.startswith("if the machine was healthy: uncertain-lti fit --update ")
    none = model | {"domain": model["domain"] | {"x_max": [-1e3] * 2, "x_min": [-2e3] * 2}}  # is it the same machine?
    (folder / "none.model.json").write_text(json.dumps(none))
    assert "fit --update" not in cli("check", folder / "none.model.json", folder / "run.mcap", status=3).out
    assert "outside the fitted domain, where nothing vouches for the bounds" in first and "says nothing" in last
    assert re.search(r"that reach as far: \w+ at [\d.-]+ to [\d.-]+ \(fitted: [\d.-]+ to [\d.-]+\)$", first)
    assert cli.json("report", path, folder / "run.mcap", status=3)["recordings"][0]["outcome"] == "unknown"
    again = folder / "again.mcap"
    again.write_bytes((folder / "run.mcap").read_bytes())
    both = cli("check", path, folder / "run.mcap", again, status=3).out
    assert "\n\nUNKNOWN: " in both  # and not below the text of the first
    again.unlink()
    printed = cli.json("check", path, folder / "run.mcap", status=3)
    assert (printed["outcome"], printed["exit_status"], printed["alarm"]) == ("unknown", 3, False)
    (recording,) = printed["recordings"]
    assert 0.4 < recording["outside_domain_share"] < 0.6 and "nothing vouches" in recording["reason"]
    (happened,) = cli.json("report", path, folder / "run.mcap", status=3)["happened"]
    assert happened["state"] == "unknown" and "nothing vouches" in happened["text"]
    share = recording["outside_domain_share"]
    for part, status in ((share - 0.05, 3), (min(share + 0.05, 0.5), 0 if share <= 0.5 else 3)):
        model["validation"] = {"part": [{"verdicts": 1000, "outside_domain": round(1000 * of)} for of in (0.1, part)]}
        path.write_text(json.dumps(model))
        assert cli.json("check", path, folder / "run.mcap", status=status)["exit_status"] == status
    model["validation"] = {"part": [3, {"verdicts": "many"}, {"verdicts": 0, "outside_domain": 0}]}  # of another hand
    path.write_text(json.dumps(model))
    assert cli.json("check", path, folder / "run.mcap", status=3)["outcome"] == "unknown"


@pytest.mark.parametrize(
    ("begin_s", "step_s", "lasts", "words"),
    [
        (1.7e9, 3600, 80, "first at 2023-11-15T23:13:20 UTC, 25 h on, for 3.29 days"),
        (0.0, 3600, 2, "first at 90000.0000 s for 60 min"),
        (1.7e9, 0.1, 1, "first at 2.5000 s for one verdict"),
        (1.7e9, 0.1, 3, "first at 2.5000 s for 0.2 s"),
    ],
)
def test_an_alarm_is_dated_where_seconds_say_nothing(begin_s, step_s, lasts, words):
    x = np.zeros((200, 1))
    x[25 : 25 + lasts, 0] = np.arange(1, lasts + 1)
    x[25 + lasts :] = x[24 + lasts]
    t_ns = np.round((begin_s + step_s * np.arange(200)) * 1e9).astype(np.int64)
    model = UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[0.5])
    verdicts = EnvelopeMonitor(model).check(Transient(t_ns, x, np.zeros((200, 1))))
    data = check_data(model, verdicts)
    assert f"ALARM: raised once, {words}" in check_text(data)
    assert ("2023-11-15T23:13:20 UTC, 25 h on  " in check_text(data).split("ALARM")[0]) == ("UTC" in words)
    jump = {**data["alarms"][0], "change": -1.0, "largest_in_fit": 0.5, "text": "x1 jumped"}
    data["states"]["x1"]["jump"] = jump
    at = words.removeprefix("first at ").rpartition(" for ")[0].rstrip(",")
    assert f"x1 jumped at {at}" in check_text(data).splitlines()
    for i in range(7):  # of a plant's many states those that jumped farthest for what they are
        new = {**jump, "largest_in_fit": 0.1 * (9 - i), "text": f"jump {i}"}
        data["states"][f"other {i}"] = {**data["states"]["x1"], "jump": new}
    jumps = [line.partition(" at ")[0] for line in check_text(data).splitlines() if "jump" in line]
    assert jumps == ["jump 6", "jump 5", "x1 jumped", "jump 4", "jump 3", "  and 3 more jumps; --json has all"]
    (told,) = findings(model, "m.model.json", [verdicts])["happened"]
    assert ("first at 2023-11-15T23:13:20 UTC, 25 h on" in told["text"]) == (at.endswith("on"))


def test_a_quiet_recording_says_how_near_to_an_alarm_it_came():
    """Of the states that count, and where they count; with several recordings the last table has all of them."""
    x = np.zeros((300, 2))
    x[20:, 0], x[60:, 1] = 0.5, 0.7
    rule = StatisticRule("mean", 0.0, 2.0)
    model = UncertainLTI(
        np.zeros((2, 2)), np.zeros((2, 0)), np.zeros((2, 2)), np.zeros((2, 0)), v=[0.5, 0.5], alarm=[rule]
    )
    near = Transient(np.arange(300.0), x, np.zeros((300, 0)), name="near")
    quiet = check_data(model, EnvelopeMonitor(model).check(near))
    assert check_text(quiet).splitlines()[-2:] == [
        "nearest to an alarm: mean of x2 at 0.7 times its threshold, at 60.0000 s", "no alarm",
    ]  # fmt: skip
    masked = check_data(model, EnvelopeMonitor(model, masked=["x2"]).check(near))
    assert masked["farthest"] == {**masked["farthest"], "state": "x1", "k": 20, "value": 0.5}
    x[200:, 0] = -5.0
    loud = check_data(model, EnvelopeMonitor(model).check(near.replace(x=x, name="loud")))
    assert loud["farthest"]["value"] == -5.5 and "nearest" not in check_text(loud)
    assert overview([quiet, loud]).rows == [
        ["near", "no alarm", "-", "0.7", "mean of x2"],
        ["loud", "ALARM", "200.0000 s", "5.5", "mean of x1"],
    ]
    plain = check_data(model, EnvelopeMonitor(model.replace(alarm=[AlarmRule()])).check(near))
    assert plain["farthest"] is None and overview([plain]).rows[0][3:] == ["", ""]


def test_the_longest_alarm_is_told_beside_the_first():
    """What raised the first, of a moment, is not what matters, nor how far it was beyond its threshold there."""
    x = np.zeros((300, 2))
    x[20:, 0] = 1.0  # a step of one verdict, and later a ramp with a step in it
    x[100:140, 1] = np.arange(1.0, 41.0)
    x[140:, 1] = 40.0
    x[120:, 1] += 1.0
    rule = StatisticRule("energy", 0.0, 1.5)
    model = UncertainLTI(
        np.zeros((2, 2)), np.zeros((2, 0)), np.zeros((2, 2)), np.zeros((2, 0)), v=[0.5, 0.5], alarm=[rule]
    )
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(300.0), x, np.zeros((300, 0))))
    first, by, longest, by_then, most = check_text(check_data(model, verdicts)).splitlines()[-5:]
    assert first == "ALARM: raised 2 times, first at 20.0000 s for one verdict" and by.startswith(
        "  raised by energy of x1"
    )
    assert longest == "  the longest at 100.0000 s for 39 s" and by_then.startswith("  raised by energy of x2")
    assert most == "  the largest: energy of x2 at 10.7 times its threshold, at 120.0000 s"


def test_a_model_is_written_over_with_force_alone(folder, cli):
    model = folder / "m.model.json"
    before = model.read_bytes()
    another = ["fit", folder / "run.mcap", "--signals", folder / "signals.yaml", "--additive", "both"]
    said = refused(cli, *another, "--output", model)
    assert "a model is there already; choose another name, or write over it with --force" in said
    assert model.read_bytes() == before
    cli(*another, "--output", model, "--force")
    assert model.read_bytes() != before
    shutil.copy(model, folder / "other.model.json")
    assert "with --force" in refused(cli, "validate", model, "--output", folder / "other.model.json")
    cli("validate", model, "--output", model)  # the model itself gets its validation


def test_of_several_recordings_one_that_lacks_a_topic_keeps_none_from_being_checked(folder, tmp_path, cli):
    other = write([Topic("/elsewhere")], ramp("/elsewhere", range(3))).save(tmp_path / "other.mcap")
    run, model = str(folder / "run.mcap"), str(folder / "m.model.json")
    shutil.copy(run, tmp_path / "again.mcap")
    said = cli("check", model, run, other, tmp_path / "again.mcap", status=2)
    assert said.out.count(" verdicts, ") == 2
    assert "other.mcap: there is no topic /engine/" in said.err and "1 of 3 recordings not checked" in said.err
    data = cli.json("check", model, other, run, status=2)
    assert data["outcome"] == "unknown" and len(data["recordings"]) == 1
    assert [r["recording"] for r in data["not_checked"]] == [str(other)]
    assert "1 of 3" not in refused(cli, "check", model, other)
    page = tmp_path / "page.html"
    for command in ("report", "plot"):
        said = cli(command, model, other, run, "--output", page, status=2).err
        assert "1 of 2 recordings not checked" in said and page.exists()
        page.unlink()
        shutil.copy(other, tmp_path / "third.mcap")
        said = cli(command, model, other, tmp_path / "third.mcap", "--output", page, status=2).err
        assert "2 of 2 recordings not checked" in said and not page.exists()


def test_of_several_recordings_one_that_cannot_be_opened_keeps_none_from_being_checked(folder, tmp_path, cli):
    run, model, empty = str(folder / "run.mcap"), str(folder / "m.model.json"), tmp_path / "empty.mcap"
    empty.touch()
    for other, why in ((empty, "the file is empty"), (tmp_path / "none.mcap", "there is no such file")):
        said = cli("check", model, other, run, status=2)
        assert said.out.count(" verdicts, ") == 1
        assert why in said.err and "1 of 2 recordings not checked" in said.err
        assert [r["recording"] for r in cli.json("check", model, run, other, status=2)["not_checked"]] == [str(other)]
    assert "2 of 2 recordings not checked" in cli("check", model, empty, tmp_path / "none.mcap", status=2).err
    assert "named twice" in refused(cli, "check", model, run, run)
    page, image = tmp_path / "page.html", tmp_path / "image.png"
    for command in ("report", "plot"):
        cli(command, model, empty, run, "--output", page, status=2)
        assert page.exists()
        page.unlink()
    assert "an image shows one recording" in cli("plot", model, empty, run, "--output", image, status=2).err
    assert not image.exists()


def test_the_rate_of_bursts_is_that_of_the_whole(tmp_path, cli):
    """Three messages within a microsecond, twice a second."""
    times = [k * 500_000_000 + j * 300 for k in range(20) for j in range(3)]
    path = write([Topic("/a")], ramp("/a", times)).save(tmp_path / "a.mcap")
    assert re.search(r"/a .* 60 +6\.\d+ in bursts ", cli("topics", path).out)
    (topic,) = cli.json("topics", path)["topics"]
    assert topic["bursts"] and topic["rate"] == pytest.approx(60 / 9.5, rel=0.05)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fit", "a.mcap", "--signals", "s.yaml", "--outptu", "m"], "there is no --outptu (is --output meant?)"),
        (["start", "--table", "unit=ms", "a.csv"], "required: BAG; --table takes all that follows it, so put it last"),
        (["check", "m", "a.mcap", "--jsn"], "unrecognized arguments: --jsn (is --json meant?)"),
        (
            ["topics", "a.mcap", "b.mcap"],
            "arguments: b.mcap; that is one more than it takes: uncertain-lti topics --help",
        ),
        (["check", "m", "a.mcap", "--window", "5", "b.mcap"], "arguments: b.mcap; name every BAG in one row, without"),
        (["check", "m", "a.mcap", "--discard", "1"], "--discard 1 (an option of fit)"),
        (["chek", "m", "b"], "(is check meant?)"),
        (["fit", "b", "--signals", "s", "--output", "m", "--additive", "noies"], "(is noise meant?)"),
        (["fit", "b", "--signals", "s", "--output", "m", "--discard", "abc"], "neither a whole number nor a share"),
        (["check", "m", ""], "argument BAG: the name is empty"),
        *(
            (["fit", "b", "--signals", "s", "--output", "m", "--schedule", given], said)
            for given, said in (
                ("fan=x", "neither auto"),
                ("fan=", "write SIGNAL"),
                ("fan=modes:", "neither auto"),
            )
        ),
    ],
)
def test_a_near_miss_names_one_option(words, said, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert said in error and " or --" not in error.rpartition("error: ")[2]


@pytest.mark.parametrize("words", ["check m -a.mcap", "check m b.mcap -a.mcap", "topics -a.mcap"])
def test_a_file_whose_name_begins_with_a_dash_is_told_how_to_be_given(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("-a.mcap").touch()
    with pytest.raises(SystemExit):
        main(words.split())
    assert "; the file -a.mcap is given as ./-a.mcap" in capsys.readouterr().err


def test_what_is_proposed_and_written_as_json(folder, tmp_path, cli):
    data = cli.json("init", folder / "run.mcap")
    assert {"name", "topic", "field"} <= set(data["states"][0]) and data["text"].startswith("# Proposed by")
    layout = tmp_path / "l.json"
    assert cli.json("layout", folder / "m.model.json", "--foxglove", layout)["layouts"] == [str(layout)]


def test_no_line_names_every_signal_of_a_large_plant(tmp_path, cli):
    rng, count = np.random.default_rng(1), 18
    x, u = np.zeros((2, 800, count))
    for k in range(799):  # a feedback sets every valve
        u[k] = 0.1 * rng.standard_normal(count) - 2.0 * x[k]
        x[k + 1] = x[k] + 0.1 * (u[k] - x[k]) + 0.2 * rng.standard_normal(count)
    names = [f"{what}_{i}" for what in ("speed", "valve_cmd") for i in range(count)]
    table, signals, model = tmp_path / "a.csv", tmp_path / "s.yaml", tmp_path / "m.json"
    rows = np.column_stack([0.1 * np.arange(800), x, u])
    np.savetxt(table, rows, delimiter=",", header="time," + ",".join(names), comments="", fmt="%.5f")
    given = ["--states", "/table:speed_*", "--controls", "/table:valve_cmd_*"]
    said = [cli("init", table, *given, "--output", signals), cli("fit", table, "--signals", signals, "--output", model)]
    said.append(cli("info", model))
    lines = [line for part in said for line in (part.out + part.err).splitlines()]
    for line in lines:
        most = 24 if line.startswith("UncertainLTI(") else 12  # states and controls
        assert sum(name in re.findall(r"\w+", line) for name in names) <= most, line


def test_an_alarm_is_red_where_colours_are_wanted(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value, red in (("TERM", "xterm", True), ("TERM", "dumb", False), ("NO_COLOR", "1", False)):
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv(name, value)
        Progress().say("bag: 3 verdicts\nALARM: raised 9 times")
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == "bag: 3 verdicts" and ("\x1b[1;31mALARM" in lines[1]) == red


def test_completion(tmp_path, cli):
    pytest.importorskip("shtab", reason="shtab, of the extra completion, is not installed")
    assert "validate" in cli("completion", "zsh").out
    (tmp_path / "script").write_text(cli("completion", "bash").out)
    ask = "COMP_WORDS=(uncertain-lti fit --crit); COMP_CWORD=2; _shtab_uncertain_lti; echo ${COMPREPLY[@]}"
    done = subprocess.run(["bash", "-c", f"source {tmp_path}/script; {ask}"], capture_output=True, text=True)
    assert done.stdout.split() == ["--criterion"]


def test_a_short_name_for_the_output_of_every_command():
    """`-o` names the file to write wherever `--output` does."""
    parser = build_parser(every=True)
    commands = next(action.choices for action in parser._actions if isinstance(action.choices, dict))
    taken = {name: command._option_string_actions for name, command in commands.items()}
    writing = {name for name, options in taken.items() if "--output" in options}
    assert {"init", "fit", "report", "record"} <= writing == {name for name in taken if "-o" in taken[name]}


def test_of_many_states_the_table_shows_those_most_often_outside():
    n = 50
    still = np.zeros((n, n))
    model = UncertainLTI(still, np.zeros((n, 1)), still, np.zeros((n, 1)), v=np.full(n, 0.5))
    x = np.zeros((20, n))
    x[::2, 44], x[10, 47] = 3.0, 3.0
    run = Transient(0.1 * np.arange(20), x, np.zeros((20, 1)))
    lines = check_text(check_data(model, EnvelopeMonitor(model).check(run))).splitlines()
    head = next(i for i, line in enumerate(lines) if line.split()[:2] == ["state", "violations"])
    assert [line.split()[0] for line in lines[head + 1 : head + 4]] == ["x45", "x48", "x1"]
    assert "  and 10 more rows; --json has all" in lines


def test_of_many_recordings_a_fit_says_of_the_first_what_was_read_and_of_those_that_lose_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was a line for each: of 2000 short tables 2000, above what was fitted."""
    rng, names = np.random.default_rng(0), []
    for i in range(30):
        x = np.cumsum(rng.normal(size=20)).round(3)
        rows = [f"{0.1 * k:.1f},{value}" for k, value in enumerate(x) if i != 25 or k % 4]
        names.append(str(tmp_path / f"run_{i:02}.csv"))
        Path(names[-1]).write_text("\n".join(["time,x", *rows * (1 + (i == 25))]))
    signals = tmp_path / "s.yaml"
    signals.write_text("table: {time: time}\nstates: [{name: x, topic: /table, field: x}]\ncontrols: []\n")
    fitted = [*names, "--signals", str(signals), "--alarm", "containment", "--output", str(tmp_path / "m.model.json")]
    assert main(["fit", *fitted]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if "usable transition" in line]
    assert [line.rpartition("run_")[2][:2] for line in told] == [f"{i:02}" for i in (*range(20), 25)]


def test_of_many_recordings_a_check_tells_of_those_in_alarm_and_lists_all(folder, cli):
    """It was ten lines for each: of 1000 recordings 10 000, the alarms somewhere among them."""
    calm = [shutil.copy(folder / "run.mcap", folder / f"calm_{i:02}.mcap") for i in range(21)]
    out = cli("check", folder / "m.model.json", *calm, folder / "bad.mcap", status=1).out
    told, alone, table = out.partition("in this table alone 21 recordings without an alarm:\n")
    assert alone and "bad.mcap: 300 samples" in told and "calm" not in told
    assert table.count("no alarm") == 21 and table.count("ALARM") == 1
