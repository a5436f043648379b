# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Archives: the same optimum from disk and from a cluster as in memory."""

import json
import os
import re
import signal
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from refusals import refuses

import uncertain_lti
from uncertain_lti import OperatingPoint, Transient, read_transients
from uncertain_lti.base.errors import BagError, FitError, SignalError
from uncertain_lti.base.files import whole_file
from uncertain_lti.identification import fit
from uncertain_lti.identification.archive import fit_archive, write_cache
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.fitting import fit_fleet
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.problem import BLOCK
from uncertain_lti.proposal import public_fit
from uncertain_lti.reports.model_text import fit_text, next_text

ARRAYS = ("A", "B", "dA", "dB", "c", "dc", "v")


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    (folder / "signals.yaml").write_text("additive: disturbance\n" + SIGNALS)
    return folder / "signals.yaml", [engine_bag(folder / f"run{s}x.mcap", 80 + 15 * s, s) for s in range(8)]


def equal(one, two):
    for name in ARRAYS:
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=1e-9, abs=1e-9)
    assert one.fit_summary["objective"] == pytest.approx(two.fit_summary["objective"], rel=1e-12)
    assert one.sampling == two.sampling
    assert one.signals == two.signals
    assert np.array_equal(one.domain.x_min, two.domain.x_min)
    assert np.array_equal(one.domain.step_max, two.domain.step_max)
    assert one.fit_summary["transitions"] == two.fit_summary["transitions"] and one.fit_summary["violations"] == 0
    for name, values in two.repeats.to_dict().items():
        assert one.repeats.to_dict()[name] == pytest.approx(values, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("criterion", "additive"), [("qp", "both"), ("lp", "disturbance")])
def test_from_disk_as_in_memory(bags, tmp_path, criterion, additive):
    signals, paths = bags
    transients = read_transients(paths, signals)
    model = fit(transients, criterion, additive=additive)
    same = fit_archive(paths, signals, criterion, additive, cache=tmp_path / "cache")
    equal(same, model)


def test_an_archive_has_the_alarm_of_a_fit(bags, tmp_path, monkeypatch):
    """Of all recordings where memory holds them, of some spread over them where it does not."""
    signals, paths = bags
    model = uncertain_lti.fit(read_transients(paths, signals))
    same = public_fit.fit_many(paths, signals, cache=tmp_path / "all")
    equal(same, model)
    for one, two in zip(same.alarm, model.alarm, strict=True):  # of what was fitted as well, by widths as above
        assert (one.kind, one.window_s) == (two.kind, two.window_s)
        assert one.threshold == pytest.approx(two.threshold, rel=1e-9)
    facts, own = (dict(m.fit_summary["alarm"]) for m in (same, model))
    assert facts.pop("biases") == pytest.approx(own.pop("biases"), rel=1e-9) and facts == own  # of the widths, as above
    assert same.validation["parts"] == model.validation["parts"] == 8
    monkeypatch.setattr(public_fit, "SAMPLE", sum(t.x.size + t.u.size for t in read_transients(paths[:7:2], signals)))
    some = public_fit.fit_many(paths, signals, cache=tmp_path / "some")
    plain = fit(read_transients(paths, signals), some.fit_summary["criterion"])
    assert (some.repeats.largest_run >= plain.repeats.largest_run).all()  # what was left out tells of it, too
    equal(some.replace(repeats=plain.repeats), plain)
    assert some.fit_summary["alarm"]["note"] == "learnt on 4 of 8 recordings, as many as memory is for"
    assert some.fit_summary["alarm"]["units"] == 4 and some.alarm != model.alarm
    with pytest.raises(FitError, match="false_alarms is what the panel is learnt for"):
        public_fit.fit_many(paths, signals, alarm="containment", false_alarms=1.0, cache=tmp_path / "none")
    by_hand = public_fit.fit_many(paths, signals, "qp", alarm="containment", cache=tmp_path / "hand")
    equal(by_hand, fit(read_transients(paths, signals), "qp"))
    assert [rule.kind for rule in by_hand.alarm] == ["containment"]


def test_a_copy_among_the_recordings_is_refused(bags, tmp_path, monkeypatch):
    """Also where it is not among those that the alarm is learnt on."""
    signals, paths = bags
    copy = tmp_path / "copied.mcap"
    copy.write_bytes(paths[5].read_bytes())
    message = f"^{re.escape(str(copy))}: holds the samples of {re.escape(str(paths[5]))}; name each recording once"
    refuses(BagError, message, public_fit.fit_many, [*paths, copy], signals, cache=tmp_path / "cache")
    monkeypatch.setattr(public_fit, "SAMPLE", sum(t.x.size + t.u.size for t in read_transients(paths[:3], signals)))
    refuses(BagError, message, public_fit.fit_many, [*paths, copy], signals, cache=tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_each_run_of_a_table_is_one_recording(tmp_path):
    """Each run was taken as often as the table has runs, and the rate of false alarms stated from all of these."""
    rng, rows, x = np.random.default_rng(0), ["run,t,x,u"], 0.0
    for run in range(5):
        for k in range(200):
            u = float(np.sign(np.sin(k / (9 + run))))
            rows.append(f"{run},{0.1 * k:.1f},{x},{u}")
            x += 0.1 * (u - x) + 0.01 * rng.normal()
    (tmp_path / "a.csv").write_text("\n".join(rows))
    of = {"states": "x", "controls": "u"}
    entries = (f"{kind}: [{{name: {one}, topic: /table, field: {one}}}]" for kind, one in of.items())
    (tmp_path / "signals.yaml").write_text("\n".join(["table: {runs: run}", *entries]))
    for name, paths in (("all", [tmp_path / "a.csv"]), ("some", [tmp_path / f"a.csv[{run}]" for run in range(4)])):
        model = uncertain_lti.fit(read_transients(paths, tmp_path / "signals.yaml"))
        same = public_fit.fit_many(paths, tmp_path / "signals.yaml", cache=tmp_path / name)
        assert same.fit_summary["alarm"]["limit_per_hour"] == model.fit_summary["alarm"]["limit_per_hour"]
        assert same.validation["parts"] == model.validation["parts"] == (5 if name == "all" else 4)


def random_problem(seed, N, n=3, m=2, noise=1e-3):
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-1, 1, (N, n)), rng.uniform(-1, 1, (N, m))
    M = np.hstack([-np.diag(np.arange(1.0, n + 1)), np.ones((n, m))])
    spread = 0.3 * rng.uniform(0, 1, M.shape)
    z = np.hstack([x, u])
    rate = np.einsum("kj,kij->ki", z, M + spread * rng.uniform(-1, 1, (N, *M.shape)))
    pairs = np.empty((2 * N, n))
    pairs[::2], pairs[1::2] = x, x + 0.01 * rate + noise * rng.standard_normal((N, n))
    t = np.repeat(np.arange(N) * 10**9, 2) + np.tile([0, 10**7], N)
    transient = Transient(t, pairs, np.repeat(u, 2, axis=0), max_gap=0.1)
    return transient, assemble([transient], OperatingPoint.identity(n, m), None, "noise")


def test_scheduled_from_disk_as_in_memory(bags, tmp_path):
    """A further signal that schedules nothing is left out with a note, as in memory."""
    signals, paths = bags
    further = "scheduling:\n" + "".join(
        f"  - {{name: {name}, topic: /engine/control, field: 'position[{of}]'}}\n"
        for name, of in (("level", "main_fuel_flow"), ("weather", "nozzle_throat_area"))
    )
    (tmp_path / "signals.yaml").write_text(signals.read_text() + further)
    schedule = {"level": (-0.05, 0.0, 0.05)}
    runs = read_transients(paths, tmp_path / "signals.yaml")
    same = fit_archive(paths, tmp_path / "signals.yaml", schedule=schedule, cache=tmp_path / "cache")
    additive = same.fit_summary["additive"]
    model = uncertain_lti.fit(runs, "qp", additive=additive, schedule=schedule, alarm="containment")
    equal(same, model)
    assert same.schedule == model.schedule and same.block_data == model.block_data
    noted = [[m for m in one.fit_summary["messages"] if "schedules nothing" in m] for one in (same, model)]
    assert noted[0] == noted[1] and len(noted[0]) == 1 and "'weather'" in noted[0][0]
    assert f"note: {noted[0][0]}" in fit_text(same)
    assert "schedules nothing" not in next_text(same, "m.json")


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_many_blocks_and_passes_from_disk(tmp_path, criterion):
    """More samples than are held: screening and passes over its blocks."""
    parts = [random_problem(seed, count) for seed, count in enumerate((BLOCK + 1, 5, 4321))]
    whole = fit([t for t, _ in parts], criterion, additive="noise")
    partition = write_cache(tmp_path / "c", (p for _, p in parts))
    assert partition.N == sum(p.N for _, p in parts)
    stacked = np.hstack([block.z for block in partition.blocks()])
    assert np.array_equal(stacked, np.hstack([p.z for _, p in parts]))
    model = fit_fleet(Fleet([partition]), whole.signals, criterion)
    objective = pytest.approx(whole.fit_summary["objective"], rel=1e-12)
    assert model.fit_summary["objective"] == objective
    assert model.dA == pytest.approx(whole.dA, rel=1e-9, abs=1e-9)
    # and in parts, as a cluster would hold them
    fleet = Fleet([p for _, p in parts])
    assert fit_fleet(fleet, whole.signals, criterion).fit_summary["objective"] == objective
    assert fleet.judge(model).outside.sum() == 0


def test_cut_cache_and_wrong_folders_are_named(tmp_path):
    _, problem = random_problem(0, 9000)
    partition = write_cache(tmp_path / "c", [problem])
    data = tmp_path / "c" / "transitions.f64"
    data.write_bytes(data.read_bytes()[:-8])
    with pytest.raises(FitError, match="cut short"):
        list(partition.blocks())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("")
    (tmp_path / "c" / ".transitions.f64-x.tmp").write_bytes(b"of a writer that was killed")
    write_cache(tmp_path / "c", [problem])
    refuses(FitError, r"thesis\.tex.*no cache", write_cache, tmp_path / "other", [problem])


def test_bad_archives_are_refused(bags, tmp_path):
    signals, paths = bags
    auto = tmp_path / "auto.yaml"
    auto.write_text(SIGNALS.replace('field: "position[fan_speed]"', 'field: "position[fan_speed]", steady: auto'))
    refuses(SignalError, "'fan' has auto", fit_archive, paths, auto, cache=tmp_path / "c")
    refuses(FitError, "cache or on a cluster", fit_archive, paths, signals)
    rest = tmp_path / "rest.yaml"
    rest.write_text(SIGNALS)
    still = engine_bag(tmp_path / "still.mcap", 60, change=lambda k, x: x * 0 + (1.0 if k == 40 else 0.0))
    control = engine_bag(tmp_path / "moving.mcap", 60, 3)
    refuses(FitError, "at rest.*--additive noise", fit_archive, [still, control], rest, cache=tmp_path / "c")


@contextmanager
def started_cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0") as local:
        with distributed.Client(local) as client:
            yield local, client


@pytest.fixture(scope="module")
def cluster():
    with started_cluster() as started:
        yield started


def steps_of(lines, what):
    """The numbers `k of 8` of the lines that begin with these words."""
    return [int(line.split("(")[-1].split(" of 8")[0]) for line in lines if line.startswith(what)]


@pytest.mark.slow
def test_on_a_cluster_as_in_memory(bags, cluster):
    signals, paths = bags
    lines = []
    equal(fit_archive(paths, signals, client=cluster[1], progress=lines.append), fit(read_transients(paths, signals)))
    assert steps_of(lines, "looking at") == steps_of(lines, "reading") == list(range(1, 9))


@pytest.mark.slow
def test_on_a_cluster_the_recording_that_leaves_rest_is_named(cluster, tmp_path):
    """Also where a recording before it has no transition."""
    (tmp_path / "s.yaml").write_text(SIGNALS)
    short = engine_bag(tmp_path / "a.mcap", 1, 3)
    still = engine_bag(tmp_path / "b.mcap", 60, change=lambda k, x: x * 0 + (1.0 if k == 40 else 0.0))
    control = engine_bag(tmp_path / "c.mcap", 60, 3)
    for where in ({"client": cluster[1]}, {"cache": tmp_path / "cache"}):
        with pytest.raises(FitError, match=r"^transition \d+ of \S*b\.mcap begins at rest"):
            fit_archive([short, still, control], tmp_path / "s.yaml", **where)


def test_it_says_how_far_it_has_come(bags, tmp_path):
    signals, paths = bags
    lines = []
    fit_archive(paths, signals, cache=tmp_path / "c", progress=lines.append)
    assert steps_of(lines, "looking at ") == steps_of(lines, "reading ") == list(range(1, 9))


@pytest.mark.slow
def test_a_lost_worker_costs_time_and_nothing_else(bags):
    signals, paths = bags
    model = fit(read_transients(paths, signals))
    with started_cluster() as (local, client):
        pid = next(iter(local.workers.values())).process.process.pid
        killer = threading.Timer(0.3, os.kill, (pid, signal.SIGKILL))
        killer.start()
        again = 0
        while killer.is_alive() or not again:  # until the kill has fallen into the middle of one of them, and once more
            again += not killer.is_alive()
            equal(fit_archive(paths, signals, client=client), model)


def test_a_worker_that_cannot_start_is_a_sentence(bags, tmp_path, monkeypatch, capsys):
    from uncertain_lti.cli.main import main

    def refuse(**options):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr("distributed.LocalCluster", refuse)
    signals, paths = bags
    arguments = ["--signals", str(signals), "--output", str(tmp_path / "a.json"), "--workers", "2"]
    assert main(["fit", *map(str, paths), *arguments]) == 2
    assert "could not be started (Nanny failed to start.); start again" in capsys.readouterr().err


@pytest.mark.slow
def test_errors_of_workers_are_sentences(bags, cluster, tmp_path):
    signals, paths = bags
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(SIGNALS.replace("position[fan_speed]", "position[fan]"))
    refuses(SignalError, "there is no 'fan' in the message's names", fit_archive, paths, wrong, client=cluster[1])


def test_cache_of_the_command(bags, tmp_path, capsys):
    from uncertain_lti.cli.main import main

    signals, paths = bags
    arguments = ["fit", *map(str, paths), "--signals", str(signals)]
    arguments += ["--criterion", "qp", "--additive", "none", "--output"]
    assert main([*arguments, str(tmp_path / "a.json")]) == 0
    assert main([*arguments, str(tmp_path / "b.json"), "--cache", str(tmp_path / "cache")]) == 0
    one, two = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert np.array(one["dA"]) == pytest.approx(np.array(two["dA"]), rel=1e-9, abs=1e-9)
    assert one["fit"]["sources"] == two["fit"]["sources"]
    capsys.readouterr()


def test_what_a_killed_writer_left_goes_at_the_next_start(tmp_path):
    left, young, other = (tmp_path / name for name in (".w.mcap-1.tmp", ".w.mcap-2.tmp", ".v.mcap-1.tmp"))
    for path in (left, young, other):
        path.write_bytes(b"half")
    for path in (left, other):
        os.utime(path, (1e9, 1e9))
    with whole_file(tmp_path / "w.mcap") as first:
        os.utime(first.fileno(), (1e9, 1e9))
        with whole_file(tmp_path / "w.mcap") as stream:  # beside one that is still writing
            stream.write(b"whole")
        first.write(b"first")
    assert sorted(p.name for p in tmp_path.iterdir()) == [other.name, young.name, "w.mcap"]
    assert (tmp_path / "w.mcap").read_bytes() == b"first"
