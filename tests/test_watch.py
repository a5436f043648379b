# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`watch`: its page shows what the monitor says, to this machine alone, in a browser too."""

import base64
import json
import re
import shutil
import signal
import socket
import struct
import subprocess
import time
import urllib.error
import urllib.request
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("rclpy", reason="rclpy is not installed")

from builtin_interfaces.msg import Time
from ros_processes import Process, own_domain, until
from ros_processes import world as world
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from test_pages import array as numbers

from uncertain_lti import EnvelopeMonitor, fit, read_transients
from uncertain_lti.cli.main import main
from uncertain_lti.plants.turbofan_runs import turbofan_signals

BAGS = ROOT / "bags"
FITTED = sorted(BAGS.glob("turbofan_*_noise.mcap"))
DAMAGED = BAGS / "turbofan_fan_damage.mcap"


def address_of(watch: Process) -> str:
    watch.says("watching")
    found = re.search(r"http://127\.0\.0\.1:\d+/", watch.output)
    assert found, watch.output
    return found[0]


def get(address: str, **headers: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, ""


def drawn(address: str) -> dict[str, Any]:
    recording: dict[str, Any] = json.loads(get(f"{address}data")[1])["recordings"][0]
    return recording


def test_the_page_draws_what_the_monitor_said(world, tmp_path):
    model = fit(read_transients(FITTED, turbofan_signals()), "qp", additive="noise")
    model.save(tmp_path / "model.json")
    watch = world.command("watch", "--port", "0")
    address = address_of(watch)
    until(lambda: "; no such node is in ROS domain" in drawn(address)["note"], "a page without a node")
    assert drawn(address)["title"] == "SILENT /envelope_monitor" and drawn(address)["top"][0]["note"] == ""
    monitor = world.monitor(tmp_path / "model.json")
    until(lambda: drawn(address)["note"].endswith("nothing is heard on /envelope_monitor/flags."), "the node")
    newest = address_of(world.command("watch", "--port", "0", "--seconds", "0"))
    world.command("play", DAMAGED, "--rate", "4", "--wait", "20").succeed()
    until(lambda: "1 sample, 0 s is the newest" in drawn(newest)["note"], "the newest sample")
    (run,) = read_transients([DAMAGED], model.signals)
    offline = EnvelopeMonitor(model).check(run)
    until(lambda: f"{len(run)} samples" in drawn(address)["note"], "every sample")
    until(lambda: np.isfinite(numbers(drawn(address)["top"][0]["values"]["least"])[-1]), "the last sample's statistics")
    said = drawn(address)
    score = numbers(said["top"][0]["values"]["least"])
    expected = np.fmax.reduce(np.abs(offline.statistics), axis=1)
    expected = np.where(offline.alarm, np.fmax(expected, 1.0), expected)
    np.testing.assert_allclose(score[1:], expected[1:], rtol=1e-5)
    first = {panel["title"]: numbers(panel["values"]["least"]) for panel in said["views"]["utilisation"]}
    for i, name in enumerate(model.state_names):
        np.testing.assert_allclose(first[name][1:], offline.utilisation[1:, i], rtol=1e-4, atol=1e-5)
    onset = run.t[np.argmax(offline.alarm)] - run.t[-1]
    assert abs(said["alarms"][0][0] - onset) < 1e-6
    assert said["title"].startswith("ALARM") == bool(offline.alarm[-1])
    worst = np.nanmax(np.abs(offline.statistics[offline.alarm]), axis=0)
    of_state = {
        s: max(w for n, w in zip(offline.statistic_names, worst, strict=True) if n.endswith(f"/{s}")) for s in first
    }
    assert next(iter(first)) == max(of_state, key=lambda state: of_state[state])

    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example"):
        assert get(f"{address}data", Host=host)[0] == 403
    assert get(f"{address}other")[0] == 404
    assert get(address)[1].count("<script>") == 2

    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is not None:  # the page's own script draws every panel
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom"]
        profile = f"--user-data-dir={tmp_path / 'browser'}"
        shown = subprocess.run([*command, profile, address], capture_output=True, text=True, timeout=120).stdout
        assert shown.count('class="uplot') == 1 + model.n
        assert re.search(r"<title>ALARM (SILENT )?/envelope_monitor</title>", shown)
        assert re.search(r'<h1 class="bad">ALARM', shown) and not re.search(r'id="keys" hidden', shown)
    until(lambda: drawn(address)["title"] == "ALARM SILENT /envelope_monitor", "the alarm that stands through silence")
    world.change("deactivate")
    until(lambda: drawn(address)["title"] == "SILENT /envelope_monitor", "the end of what the alarm is of")
    monitor.signal(2)
    until(lambda: "; no such node" in drawn(address)["note"], "its end")
    assert drawn(address)["note"].startswith("Nothing has come for ") and "; it said last: " in drawn(address)["note"]
    assert drawn(address)["title"] == "SILENT /envelope_monitor"
    watch.signal(2)
    assert watch.wait() == 0


def test_numbers_that_come_before_the_flags_of_their_sample_are_drawn(world):
    address = address_of(world.command("watch", "--port", "0", "--seconds", "3600"))
    flags, numbers_ = (world.publisher(JointState, f"/envelope_monitor/{name}") for name in ("flags", "statistics"))
    world.subscribed(flags, numbers_)

    def say(publisher: Any, at: int, name: str, value: float) -> None:
        publisher.publish(JointState(header=Header(stamp=Time(sec=at)), name=[name], position=[value]))

    say(flags, 1, "speed", 0.0)
    until(lambda: "1 sample," in drawn(address)["note"], "a sample")
    say(numbers_, 1, "energy/speed", 0.25)
    say(numbers_, 2, "energy/speed", 0.5)
    until(lambda: numbers(drawn(address)["top"][0]["values"]["least"])[-1] == 0.25, "its statistic")
    say(flags, 2, "speed", 0.0)
    until(lambda: "2 samples," in drawn(address)["note"], "the next sample")
    np.testing.assert_array_equal(numbers(drawn(address)["top"][0]["values"]["least"]), [0.25, 0.5])
    say(flags, 1, "speed", 0.0)  # late
    until(lambda: "3 samples, 0 s is the newest" in drawn(address)["note"], "one that is late")
    assert np.frombuffer(base64.b64decode(drawn(address)["times"][0])).tolist() == [-1.0, 0.0, 0.0]
    for k in range(900, 1500, 100):
        say(flags, k, "speed", 0.0)
    until(lambda: "9 samples," in drawn(address)["note"], "all of them")
    time.sleep(2.1)
    assert "SILENT" not in drawn(address)["title"]  # a sample comes every 100 s
    for k in (500, 600, 700):  # a recording that is played again
        say(flags, k, "speed", 0.0)
    until(lambda: "3 samples," in drawn(address)["note"], "what came since")
    say(flags, 500, "speed", 0.0)  # and again
    until(lambda: "1 sample," in drawn(address)["note"], "what came since that")


def test_a_name_that_no_node_has_and_a_port_that_is_taken_are_refused(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with own_domain() as domain, socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        for words, said in (
            (["a b", "--port", "0"], "'a b' is no node name; write letters, digits, _ and /, as in /envelope_monitor"),
            (["--port", str(taken.getsockname()[1])], "choose another --port"),
        ):
            assert main(["watch", *words]) == 2
            assert said in capfd.readouterr().err


def test_a_reader_that_leaves_before_its_answer_prints_nothing(world):
    watch = world.command("watch", "--port", 0)
    address = address_of(watch)
    port = int(address.rsplit(":")[-1].strip("/"))
    for _ in range(10):
        with socket.create_connection(("127.0.0.1", port)) as reader:
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # leave at once
            reader.sendall(b"GET / HTTP/1.0\r\n\r\n")
    assert get(address, Host="localhost")[0] == 200
    watch.signal(signal.SIGTERM)
    assert watch.wait() == 0 and "Error" not in watch.output
