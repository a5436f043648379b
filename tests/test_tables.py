# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Tables as recordings: the bits that the same data gives in MCAP, headers and times of every kind, and bad files."""

import io
import math
import random
import re
import warnings
import zipfile
from datetime import datetime, timedelta
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import bounded
from refusals import refuses

from uncertain_lti import SignalMap, Transient, UncertainLTI, read_transients
from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.cli.main import main
from uncertain_lti.proposal.init import propose, run_column
from uncertain_lti.recordings.formats import group_recordings, open_recording
from uncertain_lti.recordings.table import Table
from uncertain_lti.recordings.table_files import _of_arrays, read_table
from uncertain_lti.sampling.reading import refuse_copies
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.values import TableLayout

SHIPPED = ROOT / "bags/turbofan_pulses_up_large_noise.mcap"
SIGNALS = ROOT / "config/signals/turbofan.yaml"


def exact_seconds(t_ns):
    return format(Decimal(int(t_ns)) / 10**9, "f")


@pytest.fixture(scope="module")
def shipped():
    (transient,) = read_transients(SHIPPED, SIGNALS)
    return transient


@pytest.fixture(scope="module")
def names(shipped):
    return [s.name for s in shipped.signals]


def signals_of(names, states, table=""):
    lines = ["additive: noise", *([f"table: {table}"] if table else []), "states:"]
    for i, name in enumerate(names):
        lines += ["controls:"] if i == states else []
        lines.append(f"  - {{name: {name}, topic: /table, field: {name}, steady: auto, scale: auto}}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def pa():
    pytest.importorskip("pyarrow.parquet", reason="pyarrow, of the extra tables, is not installed")
    return pytest.importorskip("pyarrow")


def read_csv(folder, head, rows, encoding="utf-8"):
    """The recording that a table is."""
    (folder / "a.csv").write_text("\n".join([head, *rows]), encoding=encoding)
    (bag,) = group_recordings([folder / "a.csv"])
    return bag


def rows_of(transient):
    return np.hstack([transient.x, transient.u])


def write_csv(path, transient, names, time=exact_seconds, head="time", delimiter=",", **options):
    lines = [delimiter.join([head, *names])]
    for t, row in zip(transient.t_ns, rows_of(transient), strict=True):
        lines.append(delimiter.join([time(t), *map(repr, row.tolist())]))
    path.write_text("\n".join(lines) + "\n", **options)
    return path


@pytest.fixture(scope="module")
def tables(shipped, names, tmp_path_factory):
    """The shipped bag's samples in every kind of file."""
    folder = tmp_path_factory.mktemp("tables")
    z, t = rows_of(shipped), shipped.t_ns
    made = {".csv": write_csv(folder / "run.csv", shipped, names)}
    made[".tsv"] = write_csv(folder / "run.tsv", shipped, names, str, "stamp_ns", "\t")
    made[".npz"] = folder / "run.npz"
    np.savez(made[".npz"], time_ns=t, **dict(zip(names, z.T, strict=True)))
    made[".mat"] = folder / "run.mat"
    from scipy.io import savemat

    content = {"time_ns": t, "data": dict(zip(names, z.T, strict=True)), "rate": 40.0}
    savemat(made[".mat"], content, long_field_names=True)
    return made


def expected_of(shipped):
    return shipped.t_ns.tobytes(), shipped.x.tobytes(), shipped.u[:-1].tobytes()


def given_by(transient):
    return transient.t_ns.tobytes(), transient.x.tobytes(), transient.u[:-1].tobytes()


@pytest.mark.parametrize("kind", [".csv", ".tsv", ".npz", ".mat"])
def test_the_same_bits_as_in_mcap(tables, shipped, names, kind, tmp_path):
    text = signals_of(names, len(shipped.signals.states))
    if kind == ".mat":
        text = "\n".join(line.replace("field: ", "field: data_") for line in text.split("\n"))
    (tmp_path / "s.yaml").write_text(text)
    (read,) = read_transients(tables[kind], tmp_path / "s.yaml")
    assert len(read) > 1000 and given_by(read) == expected_of(shipped)


def test_of_many_large_tables_the_numbers_of_most_are_held_only_while_they_are_read(
    tables, shipped, names, monkeypatch
):
    monkeypatch.setattr("uncertain_lti.recordings.table._HELD", 0)
    first, *bags = group_recordings([tables[".tsv"], tables[".csv"], tables[".npz"]])
    assert "times" in vars(first)  # one that is alone is not read twice, whatever its size
    paths = [[FieldPath(name) for name in names]]

    def held():
        return [key for bag in bags for key in ("times", "columns_by_field", "_rows") if key in vars(bag)]

    assert not held() and all(bag.topics["/table"].count == len(shipped) for bag in bags)
    for bag in bags:
        found = bag.columns(["/table"], paths)
        assert found.arrival.tobytes() == shipped.t_ns.tobytes() and len(held()) == 3  # of one of them
        assert found.values[0][:-1].tobytes() == rows_of(shipped)[:-1].tobytes()


def test_parquet_and_feather(pa, shipped, names, tmp_path):
    from pyarrow import feather

    columns = {"when": shipped.t_ns.astype("datetime64[ns]"), **dict(zip(names, rows_of(shipped).T, strict=True))}
    table = pa.table({name: pa.array(column) for name, column in columns.items()})
    pa.parquet.write_table(table, tmp_path / "run.parquet")
    feather.write_feather(table, tmp_path / "run.feather")
    (tmp_path / "s.yaml").write_text(signals_of(names, len(shipped.signals.states)))
    for suffix in (".parquet", ".feather"):
        (read,) = read_transients(tmp_path / f"run{suffix}", tmp_path / "s.yaml")
        assert given_by(read) == expected_of(shipped)
        (tmp_path / f"run{suffix}").write_bytes((tmp_path / f"run{suffix}").read_bytes()[:5000])
        refuses(BagError, f"run{suffix}: is damaged or no {suffix} file", open_recording, tmp_path / f"run{suffix}")


def test_lists_of_a_parquet_are_matrices_where_all_rows_have_as_many(pa, tmp_path):
    """The joints of an arm, as LeRobot writes them; a list that differs in length, or holds text, is told."""
    joints = np.arange(60.0).reshape(20, 3)
    columns = {"timestamp": pa.array(np.arange(20) / 30, pa.float32())}
    for name, kind in (("state", pa.list_(pa.float32(), 3)), ("action", pa.list_(pa.int64())), ("words", None)):
        columns[name] = pa.array(joints.astype(int if name == "action" else float).tolist(), kind)
    columns["words"] = pa.array([["a", "b"]] * 20)
    columns["uneven"] = pa.array([[1.0]] * 19 + [[1.0, 2.0]])
    columns["gap"] = pa.array([[1.0]] * 19 + [None])
    pa.parquet.write_table(pa.table(columns), tmp_path / "episode.parquet")
    table = Table(tmp_path / "episode.parquet")
    fields = table.columns_by_field
    assert set(fields) == {"state", "action"} and all((fields[name] == joints).all() for name in fields)
    left = " ".join(table.warnings)
    assert all(f"'{name}'" in left for name in ("words", "uneven", "gap")), left


def test_a_time_that_each_row_has_goes_before_that_of_a_slower_sensor(tmp_path):
    """Rows at 100 Hz with the time of a sensor at 10 Hz beside their own had gaps of minutes, as that sensor paused."""
    rows = [f"{0.1 * (k // 10) + 900 * (k > 50):.1f},{k % 7},{1.7e9 + 0.01 * k:.2f}" for k in range(100)]
    bag = read_csv(tmp_path, "elapsed time sensors,current,vicon time", rows)
    assert set(np.diff(bag.times).tolist()) == {10**7} and "column 'vicon time': it is taken for the" in bag.warnings[0]
    rows = [f"{0.1 * k:.1f},{k % 7},{1.7e9 + 0.01 * k:.2f}" for k in range(100)]
    bag = read_csv(tmp_path, "elapsed time sensors,current,vicon time", rows)
    assert set(np.diff(bag.times).tolist()) == {10**8} and not bag.warnings


def test_decimal_commas_in_quotes_are_read_unless_they_may_part_thousands(tmp_path):
    path = tmp_path / "a.csv"
    for time, numbers in (("{:.1f}", True), ("{:.0f}", False)):  # what parts decimals in one column does in each
        rows = [f'"{time.format(k)}","{1.5 + k:.3f}"'.replace(".", ",") for k in range(9)]
        path.write_text("\n".join(["time,z", *rows]))
        read = read_table(path).columns["z"]
        assert np.array_equal(read, 1.5 + np.arange(9)) if numbers else read.dtype == object


def test_points_part_thousands_where_commas_part_decimals_in_another_column(tmp_path):
    """1.234 was 1.234 between 987 and 1.300."""
    rows = [f"{k},5;{f'{980 + 10 * k:,}'.replace(',', '.')};{1 + k / 8:.3f}" for k in range(9)]
    bag = read_csv(tmp_path, "time;x;y", rows)
    assert np.array_equal(bag.columns_by_field["x"], 980 + 10 * np.arange(9)) and "'x': '.' b" in bag.warnings[-1]
    assert np.array_equal(bag.columns_by_field["y"], 1 + np.arange(9) / 8)


def test_commas_part_thousands_where_they_do_in_another_column(tmp_path):
    """1,010 was 1.01 beside 980 and behind 12,345.5, without a word."""
    rows = [f"{k};{980 + 10 * k:,};{1000 + k:,};{12345.5 + k:,.1f};{1 + k / 8:.3f}" for k in range(9)]
    columns = read_csv(tmp_path, "time;x;y;z;w", rows).columns_by_field
    assert np.array_equal(columns["x"], 980 + 10 * np.arange(9)) and np.array_equal(columns["y"], 1000 + np.arange(9))
    assert np.array_equal(columns["w"], 1 + np.arange(9) / 8)


@pytest.mark.parametrize(
    ("cells", "numbers"),
    [
        (["980.5", "1,234.5", "1,001"], [980.5, 1234.5, 1001]),
        (["980,5", "1.234,5", "1.001"], [980.5, 1234.5, 1001]),
        (["980.5", "1,234", "12,000"], [980.5, 1234, 12000]),
        (["980,5", "1.234", "12.000"], [980.5, 1234, 12000]),
        (["980,5", "0.500", "1.500"], [980.5, 0.5, 1.5]),
        (["980,5", "1\u202f234,5", "2\u202f000\u202f001"], [980.5, 1234.5, 2000001]),
        (["-980", "-1'234", "1'000'000.25"], [-980, -1234, 1000000.25]),
        (["512 515", "99 515", "511 9"], None),
        (["1.234,5", "1.5", "2.5"], [math.nan, 1.5, 2.5]),
        (["error", "1.234", "980"], [math.nan, 1.234, 980]),
    ],
)
def test_separators_of_thousands_are_read_where_cells_tell_them(cells, numbers, tmp_path):
    """Such cells were gone; where most were, the column was, without a word."""
    bag = read_csv(tmp_path, "time;x;y", [f"{k};{cells[k % 3]};{k}" for k in range(9)])
    if numbers is None:
        assert bag.columns_by_field["x"].dtype == object
    else:
        assert np.array_equal(bag.columns_by_field["x"], numbers * 3, equal_nan=True)
        assert len(bag.warnings) == 1 and "'x': " in bag.warnings[0]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"])
def test_every_unicode_is_read_with_a_byte_order_mark_or_without(encoding, tmp_path):
    bag = read_csv(tmp_path, "time,größe", [f"{k},{k % 4}.5" for k in range(9)], encoding)
    assert not bag.warnings and bag.columns_by_field["größe"].tolist() == [k % 4 + 0.5 for k in range(9)]


@pytest.mark.parametrize(("names", "start"), [("time,x", 0), ("", 0), ("time,rpm,x", 100)])
def test_milliseconds_behind_a_comma_are_of_their_time(names, start, tmp_path):
    """They were a signal, and the times whole seconds; a number of three digits remains one."""
    rows = [f"2026-11-22 13:24:{k:02},{start + 37 * k:03},{k}.5" for k in range(9)]
    bag = read_csv(tmp_path, names, rows)
    assert len(bag.columns_by_field) == 1 + (start > 0) and not bag.warnings
    assert np.diff(bag.times).tolist() == [10**9 if start else 1_037_000_000] * 8


@pytest.mark.parametrize(("names", "by"), [("", " "), ("", ","), ("pos1\tvolt", "\t")])
def test_the_time_that_a_serial_monitor_writes_before_an_arrow_is_read(names, by, tmp_path):
    """As Arduino's does: it was part of the first number, and the file refused."""
    rows = [f"23:59:5{k}.010 -> {by.join([str(k), f'{k}.5'])}{2 * by}"[: None if by == " " else -2] for k in range(9)]
    path = tmp_path / "a.txt"
    path.write_text("\r\n".join([f"23:59:50.002 -> {names}"] * bool(names) + rows))
    bag = open_recording(path)
    assert np.diff(bag.times).tolist() == 8 * [10**9] and not bag.warnings
    assert list(bag.columns_by_field) == (names.split() or ["column_2", "column_3"])
    assert bag.columns_by_field[(names.split() or ["column_3"])[-1]].tolist() == [k + 0.5 for k in range(9)]


@pytest.mark.parametrize(("mark", "by"), [(":", ","), (": ", " "), ("=", "\t"), (" = ", "; ")])
def test_cells_behind_their_names_are_read(mark, by, tmp_path):
    """As a plotter of serial lines wants them; a line of the start and one cut short are left out."""
    rows = [by.join([f"t_ms{mark}{20 * k}", f"pos{mark}{k}.5", f"cmd{mark}-{k}e-3"]) for k in range(40)]
    path = tmp_path / "a.txt"
    path.write_text("\n".join(["Starting: motor 1.2", *rows, rows[-1][:9]]))
    bag = open_recording(path)
    assert np.diff(bag.times).tolist() == 39 * [20_000_000]
    assert [w.rpartition(": ")[2] for w in bag.warnings][0].startswith("2 lines with another number of cells left out")
    assert {name: column[3] for name, column in bag.columns_by_field.items()} == {"pos": 3.5, "cmd": -3e-3}


def test_a_time_of_day_goes_on_after_midnight(tmp_path):
    """It went back by a day: alarms were dated a day before the first sample."""
    seconds = [(86_397 + k) % 86_400 for k in range(9)]
    clocks = [f"{s // 3600:02}:{s // 60 % 60:02}:{s % 60:02}" for s in seconds]
    bag = read_csv(tmp_path, "time,x", [f"{clock},{k % 4}.5" for k, clock in enumerate(clocks)])
    assert np.diff(bag.times).tolist() == 8 * [10**9]


@pytest.mark.parametrize("zone", ["", "+02:00"])
def test_the_hour_that_comes_twice_is_told(zone, tmp_path):
    times = [datetime(2026, 10, 25, 2, 0) + timedelta(minutes=k - 60 * (k >= 60)) for k in range(180)]
    zones = [zone if k < 60 else zone.replace("2", "1") for k in range(180)]
    bag = read_csv(
        tmp_path, "time,x", [f"{t.isoformat()}{z},{k % 7}" for k, (t, z) in enumerate(zip(times, zones, strict=True))]
    )
    assert [" goes back by an hour" in warning for warning in bag.warnings] == [True] * (not zone)


def test_a_clock_in_three_columns_is_the_time(tmp_path):
    """Such a table had no time, and so was refused."""
    times = [datetime(2026, 11, 22, 23, 58) + timedelta(seconds=5 * k) for k in range(60)]
    rows = [f"{t.hour},{t.minute},{t.second},{t.second % 7}.5" for t in times]
    bag = read_csv(tmp_path, "H,MIN,SEC,x", [*rows[:9], "0,77,0,1.5", *rows[9:]])
    assert list(bag.columns_by_field) == ["x"] and np.diff(bag.times).tolist() == [5 * 10**9] * 59
    assert "column 'H:MIN:SEC [s]': it is put together" in bag.warnings[0] and "1 row without a time" in bag.warnings[1]


def test_columns_of_text_are_named(tmp_path, cli):
    """They were not on the list of columns, which said nothing of them."""
    bag = read_csv(tmp_path, "time,mode,x,state", [f"{k},{'am'[k % 2]},{k}.5,ok" for k in range(9)])
    said = cli("topics", bag.path).out
    assert "/table: text or instants, which are no signals: mode, state\n/table: x\n" in said


def test_a_minus_that_is_no_hyphen_is_one(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,x\n" + "".join(f"{k},\u2212{k}.5\n" for k in range(9)), encoding="utf-8")
    assert np.array_equal(read_table(path).columns["x"], -0.5 - np.arange(9)) and not read_table(path).notes


def test_a_table_of_many_columns_is_read(tmp_path):
    """Its names alone take more than what the shape was once looked for in."""
    names = [f"plant/area_{i}/measured value of the sensor" for i in range(3000)]
    rows = [",".join([str(k), *(["0.5"] * len(names))]) for k in range(5)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join(["time", *names]), *rows]))
    assert len(read_table(path).columns) == 3001


def test_every_command_takes_them(tables, shipped, names, tmp_path, cli):
    path, model, signals = str(tables[".csv"]), str(tmp_path / "m.model.json"), tmp_path / "s.yaml"
    assert f"/table: {', '.join(names)}" in cli("topics", path).out
    assert main(["init", path, "--output", str(tmp_path / "init.yaml")]) == 0
    SignalMap.load(tmp_path / "init.yaml")
    signals.write_text(signals_of(names, len(shipped.signals.states)))
    words = ["--signals", str(signals), "--output", model, "--criterion", "lp", "--alarm", "containment"]
    assert main(["fit", path, *words]) == 0
    assert "100.000% inside all bounds" in cli("check", model, path).out
    cut = tmp_path / "cut.csv"
    cut.write_text(f"{tables['.csv'].read_text()}30.5,6")
    assert "1 line with another number of cells left out" in cli("check", model, cut).err
    assert main(["validate", model]) == 0
    assert main(["report", model, path, "--output", str(tmp_path / "r.html"), "-q"]) == 0
    said = cli("check", model, path, "--write", tmp_path / "out.mcap", status=2).err
    assert "a table, and only ROS recordings are copied; leave out --write" in said
    (expected,) = UncertainLTI.load(model).fit_summary["sources"]
    assert expected["file"] == path and len(expected["sha256"]) == 64


# --- what CSV files look like ---------------------------------------------------------------------------------

DATA = [(0.0, 1.5, -2.0), (0.1, 1.25, 3.0), (0.2, 1e-3, 4.5), (0.3, 7.0, 5.0)]


def lines(delimiter=",", point=".", time=lambda t: f"{t:.1f}"):
    rows = [[time(t), repr(a), repr(b)] for t, a, b in DATA]
    return "\n".join(delimiter.join(c.replace(".", point) for c in row) for row in rows) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        "Time [s],speed,cmd\n" + lines(),
        "time,speed,cmd\r\n" + lines().replace("\n", "\r\n"),
        "\ufefftime,speed,cmd\n" + lines(),
        '"time","speed","cmd"\n' + lines(),
        "# made by a logger\n# 2026-11-22\ntime,speed,cmd\n" + lines(),
        "# time,speed,cmd\n" + lines(),
        "time,speed,cmd\ns,rpm,V\n" + lines(),
        "drive,drive,drive\ntime,speed,cmd\ns,rpm,V\n" + lines(),
        "time,speed,cmd\n[us],rpm,V\n" + lines(time=lambda t: f"{t * 1e6:.0f}"),
        "time,speed,cmd\nms,rpm,V\n" + lines(time=lambda t: f"{t * 1000:.0f}"),
        "Bench 3, run 7\n\ntime,speed,cmd\n[s],[rpm],[V]\n" + lines(),
        "time;speed;cmd\n" + lines(";", ","),
        "time\tspeed\tcmd\n" + lines("\t"),
        "time, speed, cmd\n" + lines(", "),
        "# time speed cmd\n" + lines(" "),
        "# of a bench, in s\n\n time   speed  cmd \n  " + lines("   ").replace("\n", "  \n  "),
        ",,time,speed,cmd\n" + lines(),
        "time,speed,cmd,\n" + lines().replace("\n", ",\n"),
        "time,speed,cmd\n" + lines().replace("\n", ",\n"),
        "time_on,t,speed,cmd\n" + "".join(f"0,{line}\n" for line in lines().split()),  # no time stands still
        "time_ms,speed,cmd\n" + lines(time=lambda t: f"{t * 1000:.0f}"),
        "t (us),speed,cmd\n" + lines(time=lambda t: f"{t * 1e6:.0f}"),
        "elapsed_time,speed,cmd\n" + lines(time=lambda t: f"0:00:{t:04.1f}"),
        "index,time,speed,cmd\n" + "".join(f"{i},{line}\n" for i, line in enumerate(lines().split())),
        "speed,cmd,time\n" + "".join(f"{a},{b},{t}\n" for t, a, b in DATA),
        "x,speed,cmd\n" + lines(),  # nothing is called time: the first column, which grows
    ],
)  # fmt: skip
def test_headers_delimiters_and_units(text, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text, newline="")
    table = Table(path)
    assert (table.times - table.times[0]).tolist() == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert list(table.columns_by_field)[-2:] == ["speed", "cmd"]
    assert table.columns_by_field["speed"].tolist() == [a for _, a, _ in DATA]
    assert table.columns_by_field["cmd"].tolist() == [b for _, _, b in DATA]


@pytest.mark.parametrize(
    ("cells", "first"),
    [
        (["2026-11-22T06:28:01.25Z", "2026-11-22T06:28:01.35Z"], 1795328881250000000),
        (["2026-11-22T08:28:01,250+02:00", "2026-11-22T08:28:01,350+0200"], 1795328881250000000),
        (["2026-11-22 07:28:01.25+01", "2026-11-22 02:28:01.35-04"], 1795328881250000000),
        (["1795328881.250000001", "1795328881.350000001"], 1795328881250000001),
        (["1795328881250000001", "1795328881350000001"], 1795328881250000001),
        (["1795328881250", "1795328881350"], 1795328881250000000),
        (["-0.5", "-0.4"], -500000000),
    ],
)
def test_times_are_exact(cells, first, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,x\n" + "".join(f'"{cell}",1.0\n' for cell in cells))
    assert Table(path).times.tolist() == [first, first + 10**8]


def test_columns_that_are_no_field_paths_get_names(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,Speed [rpm],/odom/twist/x,2nd,x,x,ok\n0,1,2,3,4,5,true\n1,1,2,3,4,6,false\n")
    table = Table(path)
    assert list(table.columns_by_field) == ["Speed_rpm", "odom_twist_x", "c_2nd", "x", "x_2", "ok"]
    assert table.columns_by_field["ok"].tolist() == [1.0, 0.0]


def test_what_is_missing_is_nan_and_what_is_odd_is_reported(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,x,y,label\n0,1,,a\n0.1,NA,2,b\n,3,3,c\n0.3,1_0,4,d\n0.4,5,5,e\n0.5,6")
    table = Table(path)
    np.testing.assert_array_equal(table.columns_by_field["x"], [1, np.nan, np.nan, 5])
    np.testing.assert_array_equal(table.columns_by_field["y"], [np.nan, 2, 4, 5])
    assert table.type_fields("/table")("table")["label"].kind == "string"
    assert [w.removeprefix(f"{path}: ") for w in table.warnings] == [
        "1 line with another number of cells left out, the first is line 7 (the file ends in it)",
        "column 'x': 1 cell that is no number (such as '1_0') left out",
        "1 row without a time left out",
    ]


def test_signals_that_simulink_logged_are_called_as_they_are(tmp_path):
    """As structures with time, of one signal or several; what is left out is one sentence for each reason."""
    from scipy.io import savemat
    from scipy.io.matlab import MatlabOpaque

    t = 0.1 * np.arange(50)

    def logged(*values):
        one = [{"values": v, "dimensions": 1.0, "label": np.empty((0, 0))} for v in values]
        return {"time": t, "signals": one[0] if len(one) == 1 else one}

    every = {f"s{i}": logged(np.sin(t + i)) for i in range(9)} | {"scope": logged(np.cos(t), t**2)}
    savemat(tmp_path / "a.mat", every)
    table = open_recording(tmp_path / "a.mat")
    assert {"s0", "s8", "scope_1", "scope_2"} < set(table.columns_by_field)
    assert (
        sum("left out" in text for text in table.warnings) == 1
        and "and 7 more left out, no vector" in table.warnings[0]
    )
    kinds = [(key, object) for key in ("s0", "s1", "s2", "arr")]
    dataset = np.array([(b"logs", b"MCOS", b"Dataset", 0)], dtype=kinds).view(MatlabOpaque)
    words = r"'logs' left out, an object of class Dataset: .*Dataset s by t = s\{1\}.Values.Time; .*save\('b.mat', "
    refuses(BagError, words, _of_arrays, Path("b.mat"), {"logs": dataset})


def test_a_matrix_is_an_array(tmp_path):
    q = np.arange(10.0).reshape(5, 2)
    np.savez(tmp_path / "a.npz", t=np.arange(5.0), q=q, across=q.T, few=np.ones(3), name=np.array("bench"))
    table = open_recording(tmp_path / "a.npz")
    assert [f.fields for f in table.facts()] == [("q[0..1]", "across[0..1]")]
    assert np.array_equal(table.columns_by_field["across"], q) and "'few (3)' left out, not of 5" in table.warnings[0]
    signals = SignalMap.from_dict({"states": [{"name": "q1", "topic": "/table", "field": "q[1]"}]})
    (read,) = read_transients(tmp_path / "a.npz", signals)
    assert read.x[:, 0].tolist() == [1.0, 3.0, 5.0, 7.0, 9.0]


# --- what the signals file says -------------------------------------------------------------------------------


@pytest.fixture
def many(tmp_path):
    """Three runs in one file, each from time 0, row by row."""
    rng = np.random.default_rng(1)
    rows = ["trial,clock,v,u"]
    for trial in (3, 1, 2):
        x = 0.0
        for k in range(200):
            u = float(rng.integers(-1, 2)) if k % 7 == 0 else u  # noqa: F821
            rows.append(f"{trial},{k * 20},{x!r},{u!r}")
            x += 0.02 * (-2 * x + 3 * u) + float(rng.normal(0, 1e-3))
    (tmp_path / "many.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "s.yaml").write_text(
        "additive: noise\ntable: {time: clock, unit: ms, runs: trial}\n"
        "states:\n  - {name: v, topic: /table, field: v}\ncontrols:\n  - {name: u, topic: /table, field: u}\n"
    )
    return tmp_path / "many.csv"


def test_runs_in_one_file_are_recordings(many, tmp_path, cli):
    runs = read_transients(many, tmp_path / "s.yaml")
    assert [Path(r.name).name for r in runs] == ["many.csv[3]", "many.csv[1]", "many.csv[2]"]
    assert [len(r) for r in runs] == [200] * 3 and not any(r.counters["equal stamp"] for r in runs)
    model = tmp_path / "m.model.json"
    said = cli("fit", many, "--signals", tmp_path / "s.yaml", "--output", model).out
    assert "left out one recording at a time (3 recordings)" in said
    loaded = UncertainLTI.load(model)
    assert loaded.signals.table == TableLayout("clock", "ms", "trial")
    assert len(loaded.fit_summary["sources"]) == 1 and loaded.fit_summary["transients"] == 3
    assert cli("check", model, many).out.count("199 verdicts") == 3
    assert cli("check", model, f"{many}[1]").out.count("199 verdicts") == 1
    assert "(3 recordings)" in cli("validate", model).out
    assert main(["validate", str(model), "--group", r"name=\[(\d)\]"]) == 0
    cached = tmp_path / "c.model.json"
    words = ["--signals", str(tmp_path / "s.yaml"), "--output", str(cached), "--cache", str(tmp_path / "cache")]
    assert main(["fit", str(many), *words]) == 0
    np.testing.assert_allclose(UncertainLTI.load(cached).A, loaded.A, rtol=1e-6)
    with pytest.raises(BagError, match=r"there is no run '9' in .*; there are 3, 1, 2"):
        open_recording(f"{many}[9]", layout=TableLayout("clock", "ms", "trial"))
    with pytest.raises(BagError, match="holds 3 recordings; name one of them"):
        open_recording(many, layout=TableLayout("clock", "ms", "trial"))


def test_without_a_column_of_runs_a_step_back_begins_a_segment(many):
    signals = SignalMap.from_dict({
        "table": {"time": "clock", "unit": "ms"},
        "states": [{"name": "v", "topic": "/table", "field": "v"}],
    })  # fmt: skip
    (run,) = read_transients(many, signals)
    assert len(run) == 600 and len(np.unique(run.segment)) == 3


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("{time: clok}", r"there is no column 'clok', which the signals file names for the time \(is clock meant\?\)"),
        ("{time: clock, runs: run}", "there is no column 'run', which the signals file names for the runs"),
        ("{time: clock, runs: v}", r"column 'v' has \d+ values in 600 rows, so it names no runs; choose another"),
        ("{when: clock}", r"s.yaml: table: unknown key 'when'"),
        ("{unit: day}", r"s.yaml: table: unit is 'day'.*; write one of s, ms, us, ns, min, h"),
        ("{step: fast}", r"s.yaml: table: step is 'fast'; write a number"),
        ("{step: 0}", r"s.yaml: table: step is 0.0; write the s from row to row"),
        ("{step: 1, unit: ms}", r"s.yaml: table: step is of rows without a time, and unit of a time; take one away"),
        ("{time: []}", r"s.yaml: table: time is \[\]; write the name of a column"),
        ("5", r"s.yaml: table: a mapping is wanted here, not a number"),
    ],
)
def test_what_is_wrong_with_the_layout_is_said(many, tmp_path, table, words):
    text = (tmp_path / "s.yaml").read_text().split("\n")
    (tmp_path / "s.yaml").write_text("\n".join([f"table: {table}", *text[2:]]))
    refuses((BagError, SignalError), words, read_transients, many, tmp_path / "s.yaml")


def test_rows_without_a_time_have_a_step_and_any_column_is_a_time_from_the_first_command_on(tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)
    noise, y, rows = random.Random(0), 0.0, []
    for k in range(900):
        u = float(k // 40 % 3)
        y += 0.1 * (u - y) + 0.02 * noise.gauss(0, 1)
        rows.append((8.0 * k, u, y))
    Path("run.csv").write_text("count,drive,speed\n" + "".join(f"{c},{u},{y}\n" for c, u, y in rows))
    Path("bare.txt").write_text("drive speed\n" + "".join(f"{u} {y}\n" for _, u, y in rows))
    refuses(BagError, r"bare.txt: .*`--table step=0.01`", propose, ["bare.txt"])
    cli("start", "bare.txt", "--table", "step=0.008", "--output", "bare")
    cli("init", "run.csv", "--table", "time=count", "unit=ms", "--output", "run.yaml")
    assert cli.json("topics", "bare.txt", "--table", "step=0.008")["topics"][0]["rate"] == 125
    model = UncertainLTI.load("bare.model.json")
    assert model.signals.table == TableLayout(step=0.008) and model.signals.table.to_dict() == {"step": 0.008}
    (bare,), (run,) = read_transients("bare.txt", model.signals), read_transients("run.csv", "run.yaml")
    assert bare.state_names == run.state_names == ("speed",)
    np.testing.assert_array_equal(bare.t - bare.t[0], run.t - run.t[0])


def test_a_column_that_is_not_there_names_file_and_columns(tables, tmp_path):
    signals = SignalMap.from_dict({"states": [{"name": "v", "topic": "/table", "field": "fan_sped"}]})
    words = r"run\.csv: field 'fan_sped' of /table .*\(is fan_speed meant\?\).*fields there:"
    refuses(SignalError, words, read_transients, tables[".csv"], signals)
    with pytest.raises(BagError, match=r"run\.csv: there is no topic /engine/state; topics there: /table"):
        read_transients(tables[".csv"], SIGNALS)


# --- bad and hostile files --------------------------------------------------------------------------------------


def states_rows(number):
    """A .npz file whose only array states so many rows and has none."""
    buffer, header = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (number,)})
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("t.npy", header.getvalue())
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.csv", b"", "the file is empty"),
        ("a.csv", b"time,x\n", "there is no line of numbers in it"),
        ("a.csv", b"time\n1\n2\n", "there is one column only in it.*put the columns of a recording side by side"),
        ("a.txt", b"   1.5e+00\n   2.5e+00\n", "there is one column only in it"),
        ("a.csv", b"\x00\x01\x02" * 100, "holds bytes that are no text"),
        ("a.csv", b"time x y\n1 2 3\n2 a 4\n", "apart by spaces, and not all are numbers"),
        ("a.csv", b'"t,x"\n"2020-01-01 10:00:00,1"\n"2020-01-01 10:00:01,2"\n', "each line is in quotes as a whole"),
        ("a.csv", b"linear:\n  x: 0.1\n---\nlinear:\n  x: 0.2\n", "what `ros2 topic echo` prints"),
        ("a.csv", b"x,time,y\n2,3\n1,4\n3,4\n", "header names 3 columns and its rows have 2 cells.*no column is"),
        ("a.csv", b"x,y\n2,3\n1,4\n3,4\n", "no column is called time or looks like it.*columns there: x, y"),
        ("a.csv", b"time,y\n1,2\n2,3,4\n3,4,5\n4,5,6\n5,6\n6,7\n7,8\n", "3 lines with another number of cells"),
        ("a.csv", b"time,y\n22.11.26 at 6,2\n22.11.26 at 7,3\n", "neither a number nor an ISO time"),
        ("a.csv", b'time,y\n"1,125",6\n"1,250",7\n', "as one or the other, with a point before decimals"),
        ("a.csv", b"time,y\n02/01/2026 06,2\n03/01/2026 06,3\n", "do not say which is day and which is month"),
        ("a.csv", b"time,y\n2026-11-22T06:28:00,2\n2026-13-22T06:28:01,3\n", "'2026-13-22T06:28:01' is no day or"),
        ("a.csv", b"time,y,z\n1,2,3\n2,3,4\ntime,z,y\n1,2,3\n2,3,4\n", "line 4 names other columns, or in another"),
        ("a.csv", b"time,y\n1e300,2\n2e300,3\n", "is past the year 2262"),
        *(("a.csv", b"time,x\n2026-11-22T06:28:01+%b,1\n" % zone, "time zone") for zone in (b"99:99", b"15:00")),
        *(("a.csv", b"time,x\n%b,1\n" % day, "after 2261") for day in (b"3026-11-22", b"1500-01-01")),
        ("a.xlsx", b"PK\x03\x04nothing", "a spreadsheet; save its sheet as .csv"),
        ("a.ulg", b"ULog\x01\x12\x35", "a log of PX4; write its messages as .csv"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(9), "an HDF5 file; write its signals of one time as columns of a .csv"),
        ("a.mf4", b"MDF     4.10    ", r"a measurement of CAN and the like \(MDF\); write its signals"),
        ("1.BIN", b"\xa3\x95\x80\x80", "a log of ArduPilot; write its messages as .csv"),
        ("a.npz", b"PK\x03\x04nothing", "is damaged or no .npz file"),
        ("a.npz", states_rows(10**15), "needs more memory than there is .*; copy it again"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(200), "is damaged or no .mat file|holds no column"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + bytes(200), r"save\('a.mat', '-v7'\)"),
    ],
)
def test_a_file_that_is_no_table_is_a_sentence(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    assert refuses(BagError, words, open_recording, tmp_path / name).startswith(str(tmp_path / name))


def test_objects_in_a_file_are_not_loaded(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    np.savez(tmp_path / "a.npz", t=np.arange(3.0), x=np.ones(3), bomb=np.array([Bomb()], dtype=object))
    assert list(open_recording(tmp_path / "a.npz").columns_by_field) == ["x"]
    assert not (tmp_path / "exploded").exists()


def test_bytes_that_are_no_text_and_names_that_run_together_are_columns(tmp_path):
    """The first ended in a traceback; of `a.b` and `a_b` the second took the other's place."""
    t = np.arange(4) * 0.1
    np.savez(tmp_path / "a.npz", t=t, label=np.array([b"\xff\xfe", b"on", b"", b"\xc3\xa4"]))
    assert read_table(tmp_path / "a.npz").columns["label"].tolist() == ["\ufffd\ufffd", "on", "", "ä"]
    columns = _of_arrays(tmp_path / "a.mat", {"t": t, "a": {"b": t + 1}, "a_b": t + 2}).columns
    assert {name: column[0] for name, column in columns.items()} == {"t": 0, "a_b": 1, "a_b_2": 2}


@pytest.mark.parametrize("kind", [".csv", ".npz"])
def test_damage_anywhere_is_read_or_a_sentence(tables, kind, tmp_path):
    data = tables[kind].read_bytes()
    path = tmp_path / f"hurt{kind}"
    rng = random.Random(3)
    for _ in range(10):
        hurt = bytearray(data)
        where = rng.randrange(len(hurt)) if rng.random() < 0.5 else rng.randrange(2000)
        hurt[where : where + rng.choice([1, 4, 100])] = rng.randbytes(rng.choice([1, 4, 100]))
        path.write_bytes(hurt[: rng.randrange(1, len(hurt))] if rng.random() < 0.3 else hurt)
        try:
            list(open_recording(path).facts())
        except BagError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)


def test_a_folder_of_tables_is_not_one_recording(tables):
    folder = tables[".csv"].parent
    words = re.escape(f"a folder of tables, each of which is a recording; name them, {folder}/*.csv: run.csv")
    refuses(BagError, words, group_recordings, [folder])


def test_a_run_named_without_a_column_for_it(tables):
    refuses(BagError, r"names a run; say in the signals file which column does", open_recording, f"{tables['.csv']}[2]")


# --- what must not pass in silence ----------------------------------------------------------------------------


def write(path, *text):
    path.write_text("\n".join(text) + "\n")
    return path


def test_an_unclosed_quote_is_a_sentence_with_its_line(tmp_path):
    rows = [f"{i},{i},on" for i in range(3000)]
    rows[1000], rows[2500] = '1000,1000,"on', '2500,2500,on"'
    with pytest.raises(BagError, match="line 1002 opens a quote that is not closed in it"):
        Table(write(tmp_path / "a.csv", "time,x,mode", *rows))


@pytest.mark.parametrize(("times", "warned"), [(1000, ["ms"]), (1e6, ["us"]), (100, [])])
def test_a_file_whose_times_seem_to_be_in_another_unit_is_told(tmp_path, times, warned):
    """Of one robot, whose author wrote ms first: 9581 s were fitted beside 8 s, and the advice was `step: constant`."""
    one, other = (
        write(tmp_path / name, "time,x", *(f"{0.011 * k * factor},{k}" for k in range(9)))
        for name, factor in (("a.csv", times), ("b.csv", 1))
    )
    words = [w for bag in group_recordings([one, other]) for w in bag.warnings if "call its column time_" in w]
    assert [w.rpartition("_")[2] for w in words] == warned


def test_rows_without_a_run_are_counted(tmp_path):
    path = write(tmp_path / "a.csv", "time,x,run", "0,1,a", "1,2,", "2,3,", "3,4,b")
    tables = group_recordings([path], layout=TableLayout(runs="run"))
    assert [t.path.name for t in tables] == ["a.csv[a]", "a.csv[b]"]
    assert any("2 rows without a run left out" in w for t in tables for w in t.warnings)


def test_runs_stay_apart(tmp_path):
    path = write(tmp_path / "a.csv", "time,x,run", "0,1,a[1]", "1,2,a(1)")
    refuses(
        BagError,
        r"runs 'a\(1\)' and 'a\(1\)'|would have one name",
        group_recordings,
        [path],
        layout=TableLayout(runs="run"),
    )
    long = [12345678901234567 + i for i in (0, 0, 1, 1)]
    path = write(tmp_path / "b.csv", "time,x,run", *(f"{i},{i},{run}" for i, run in enumerate(long)))
    assert [t.path.name for t in group_recordings([path], layout=TableLayout(runs="run"))] == [
        f"b.csv[{r}]" for r in long[::2]
    ]


@pytest.mark.parametrize("odd", ["\x0c", "\x0b", "\x85", "\u2028"])
def test_only_line_ends_end_a_line(tmp_path, odd):
    path = tmp_path / "a.csv"
    path.write_text(f"made by{odd}somebody{odd}\ntime,x\n0,1\n1,2\n2,3\n", encoding="utf-8")
    assert len(Table(path).times) == 3


def test_a_column_that_stands_still_is_no_time(tmp_path):
    with pytest.raises(BagError, match="'time_on' is the same in all rows, and no other is called time"):
        Table(write(tmp_path / "a.csv", "speed,time_on", "3,0", "1,0", "2,0"))


def test_a_damaged_time_costs_its_row(tmp_path):
    path = write(tmp_path / "a.csv", "time,x", "0,1", "1,2", "2.7e151,3", "3,4", "4,5")
    table = Table(path)
    assert table.columns_by_field["x"].tolist() == [1, 2, 4, 5]
    assert any("1 row without a time left out" in text for text in table.warnings)
    refuses(BagError, "past the year 2262", Table, write(tmp_path / "b.csv", "time,x", "1e151,1", "2e151,2", "3,3"))


def test_a_counter_tells_no_runs_where_stamps_repeat(tmp_path):
    rows = (f"{k // 40},{math.sin(k)},{k // 40}" for k in range(400))
    path = write(tmp_path / "a.csv", "time,speed,minutes_on", *rows)
    assert run_column(group_recordings([path])) == ""


def test_the_finest_column_tells_the_runs_and_settings_of_a_run_are_no_states(tmp_path):
    """A load was the run, so that each left out was one that nothing else showed, and numbers of runs were states."""
    rng, rows = np.random.default_rng(0), []
    for load, run, again in ((load, run, k) for load in (20, 40, -40) for run in range(4) for k in range(2)):
        x, group = 0.0, len(rows) // 60
        for k in range(60):
            rows.append(f"{0.04 * k:.2f},{x},{(u := k // 9 % 2)},{load},{run},{group},{again}")
            x += 0.2 * (u - x) + 0.01 * rng.normal()
    path = write(tmp_path / "a.csv", "time,position,command,load,run,group,again", *rows)
    assert run_column(group_recordings([path])) == "group"
    assert [c.name for c in propose([path]).states] == ["position"]
    path.write_text(path.read_text().replace("group", "row_of_it"))  # in any words
    assert run_column(group_recordings([path])) == "row_of_it"
    few = write(
        tmp_path / "b.csv",
        "time,position,command,run",
        *(",".join(r.split(",")[i] for i in (0, 1, 2, 4)) for r in rows),
    )
    proposal = propose([few])
    assert "runs" not in proposal.text and [c.name for c in proposal.states] == ["position"], proposal.text


def test_a_time_that_counts_the_rows_is_told(tmp_path):
    """Of 250 rows a second, hours without a false alarm were said of seconds."""
    for first, step, told in ((1, 1, True), (7, 1, False), (0, 2, False)):
        bag = read_csv(tmp_path, "Time,x", (f"{first + step * k},{k % 3}" for k in range(1500)))
        assert any("'Time': its numbers are those of the rows, taken for s: of" in w for w in bag.warnings) == told
    assert not read_csv(tmp_path, "time_s,x", (f"{k},{k % 3}" for k in range(1500))).warnings


def test_an_unsigned_column_that_falls_is_no_time(tmp_path):
    np.savez(tmp_path / "a.npz", depth=np.array([9, 7, 4, 2], dtype=np.uint8), x=np.arange(4.0))
    refuses(BagError, "no column is called time", Table, tmp_path / "a.npz")


def test_instants_beyond_ns_in_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", time=np.array(["3026-01-01", "3026-01-02"], dtype="datetime64[s]"), x=np.arange(2.0))
    refuses(BagError, "after 2261", Table, tmp_path / "a.npz")


def test_nanoseconds_with_a_gap_stay_exact(pa, tmp_path):
    begin = 1_700_000_000_000_000_001
    times = pa.array([begin, None, begin + 7], pa.int64())
    columns = {"time": times, "x": [1.0, 2.0, 3.0], "mode": ["a", "b", "c"]}
    pa.parquet.write_table(pa.table(columns), tmp_path / "a.parquet")
    pa.parquet.write_table(pa.table(columns | {"time": pa.array([None] * 3, pa.string())}), tmp_path / "b.parquet")
    refuses(BagError, r"b\.parquet: column 'time': holds no time in any row", Table, tmp_path / "b.parquet")
    table = Table(tmp_path / "a.parquet")
    assert table.times.tolist() == [begin, begin + 7] and table.type_fields("/table")("table")["mode"].kind == "string"


def test_equal_names_do_not_take_for_ever(tmp_path):
    number = 3000
    rows = [",".join([str(i)] * (number + 1)) for i in range(3)]
    path = write(tmp_path / "a.csv", ",".join(["time"] + ["x"] * number), *rows)
    with bounded(seconds=5):
        assert len(Table(path).columns_by_field) == number


@pytest.mark.parametrize("kind", ["duration[us]", "time64[us]", "time32[ms]"])
def test_times_of_arrow_that_are_no_instants_are_read(pa, tmp_path, kind):
    unit = 10**3 if "ms" in kind else 10**6
    steps = pa.array([k * unit // 50 for k in range(9)], pa.int32() if "ms" in kind else pa.int64())
    path = tmp_path / "a.parquet"
    types = {"duration[us]": pa.duration("us"), "time64[us]": pa.time64("us"), "time32[ms]": pa.time32("ms")}
    pa.parquet.write_table(pa.table({"time": steps.cast(types[kind]), "x": np.arange(9.0)}), path)
    (tmp_path / "s.yaml").write_text("states: [{name: x, topic: /table, field: x}]")
    (t,) = read_transients(path, tmp_path / "s.yaml")
    assert np.diff(t.t_ns).tolist() == [20_000_000] * 8


def test_a_small_parquet_that_expands_is_refused(pa, tmp_path):
    column = pa.array(np.zeros(10_000_000))
    path = tmp_path / "a.parquet"
    pa.parquet.write_table(pa.table({f"c{i}": column for i in range(15)}), path)
    assert path.stat().st_size < 1_000_000
    refuses(BagError, "more than is read of a file of its size", Table, path)


def test_rows_that_a_damaged_parquet_does_not_list_are_not_lost_in_silence(pa, tmp_path):
    path = tmp_path / "a.parquet"
    pa.parquet.write_table(pa.table({name: np.arange(200.0) for name in ("time", "x")}), path)
    data, rows, fewer = path.read_bytes(), b"\x90\x03", b"\x90\x02"  # 200 and 136, as the footer writes them
    refused = 0
    for at in (i for i in range(len(data)) if data.startswith(rows, i)):
        path.write_bytes(data[:at] + fewer + data[at + 2 :])
        try:
            assert len(Table(path).times) == 200
        except BagError as error:
            refused += "it states 200 rows, and 136 are read" in str(error)
    assert refused


def test_a_mat_file_that_breaks_its_reader_down_is_a_sentence(tables, tmp_path):
    """A flipped bit was a segmentation fault of the reader, and the end of the command."""
    data = tables[".mat"].read_bytes()
    rng = random.Random(1)
    path = tmp_path / "a.mat"
    for _ in range(2):
        hurt = bytearray(data)
        hurt[128 + rng.randrange(64)] ^= 1 << rng.randrange(8)
        path.write_bytes(hurt)
        try:
            Table(path)
        except BagError as error:
            assert str(path) in str(error) and "\n" not in str(error)


def test_days_are_read_where_one_order_of_day_and_month_alone_goes_forward(tmp_path):
    """As an hourly table of a plant has them: two digits of the year, and the hour alone."""
    path = tmp_path / "a.csv"
    path.write_text("DATETIME,x\n" + "".join(f"{12 + k // 24:02}/01/14 {k % 24:02},{k}\n" for k in range(48)))
    (run,) = read_transients(path, SignalMap.from_dict({"states": [{"name": "x", "topic": "/table", "field": "x"}]}))
    assert set(np.diff(run.t_ns).tolist()) == {3600 * 10**9}
    assert run.t_ns[0] == np.datetime64("2014-01-12T00:00", "ns").astype(int)


@pytest.mark.parametrize(
    "form",
    [
        "10/26/2025 {hour:02}:{m:02}:05 {zone}", "10/26/2025 {hour}:{m:02}:05 AM {zone}",
        "2025-10-26 {hour:02}:{m:02}:05 {name}", "Sun Oct 26 {hour:02}:{m:02}:05 {name} 2025",
    ],
)  # fmt: skip
def test_a_day_has_the_zone_behind_it(tmp_path, form):
    """As .NET, Python and date(1) write an instant; the clock is put back from two hours before UTC to one."""
    rows = []
    for k in range(180):
        local, zone, name = (k, "+02:00", "CEST") if k < 60 else (k - 60, "+01:00", "CET")
        rows.append(form.format(hour=2 + local // 60, m=local % 60, zone=zone, name=name) + f",{k}")
    bag = read_csv(tmp_path, "Ts,x", rows)
    assert bag.times[0] == np.datetime64("2025-10-26T00:00:05", "ns").astype(int)
    assert set(np.diff(bag.times).tolist()) == {60 * 10**9}


def test_rows_of_one_day_or_of_even_steps_tell_day_and_month_apart(tmp_path):
    bag = read_csv(tmp_path, "Time,x", (f"09/04/2021 11:{k // 60:02}:{k % 60:02},{k}" for k in range(90)))
    assert set(np.diff(bag.times).tolist()) == {10**9}
    assert "column 'Time': its dates are taken for day, month, year" in " ".join(bag.warnings)
    with warnings.catch_warnings(action="error"):  # numpy knows no zones
        zoned = read_csv(tmp_path, "Time,x", (f"09/04/2021 11:{k // 60:02}:{k % 60:02} +01:00,{k}" for k in range(90)))
    assert (bag.times - zoned.times == 3600 * 10**9).all() and len(zoned.warnings) == len(bag.warnings)
    for order, first, second in (("day, month", "09/10/16", "10/10/16"), ("month, day", "10/09/16", "10/10/16")):
        bag = read_csv(tmp_path, "Time,x", (f"{first if k < 24 else second} {k % 24:02},{k}" for k in range(48)))
        assert set(np.diff(bag.times).tolist()) == {3600 * 10**9}
        assert f"its dates are taken for {order}, year" in " ".join(bag.warnings)


WRITTEN = (  # over noon; %I %p as English has it
    "%m/%d/%Y %I:%M:%S %p", "%m/%d/%Y  %I:%M:%S.000 %p", "%Y-%m-%d %I:%M:%S%p", "%I:%M:%S %p", "%d-%b-%y %I.%M.%S %p",
    "%m/%d/%Y %I:%M:%S A.M.", "%d-%b-%Y %H:%M:%S", "%d %B %Y, %H:%M:%S", "%b %d, %Y %I:%M:%S %p",
    "%a %b %d %H:%M:%S %Y", "%a, %d %b %Y %H:%M:%S GMT",
    "%a %b %d %Y %H:%M:%S GMT+0000 (Coordinated Universal Time)",
    "%Y/%m/%d %H:%M:%S", "%Y.%m.%d %H:%M:%S", "%d-%m-%Y %H:%M:%S", "%Y%m%dT%H%M%S", "%Y-%m-%d_%H-%M-%S",
    "%Y%m%d%H%M%S", "%Y-%m-%d %H:%M:%S:000", "%d %m %Y %H:%M:%S", "%d-%m-%y %H:%M:%S", "%Y %m %d %H %M %S",
)  # fmt: skip


@pytest.mark.parametrize("form", WRITTEN)
def test_times_as_spreadsheets_and_controllers_write_them(form, tmp_path):
    """A temperature beside them was taken for the time (`temp` for French), or one hour after noon for one at night."""
    start = datetime(2024, 3, 13, 11, 59, 30)
    instants = [start + timedelta(seconds=k) for k in range(60)]
    cells = [t.strftime(form.replace("A.M.", "a.m." if t.hour < 12 else "p.m.")) for t in instants]
    bag = read_csv(tmp_path, "Timestamp;x;Temp", (f'"{cell}";{k};{20 + k % 7}' for k, cell in enumerate(cells)))
    day = start if "%d" in form else datetime(1970, 1, 1, 11, 59, 30)
    assert bag.times[0] == np.datetime64(day, "ns").astype(np.int64)
    assert set(np.diff(bag.times).tolist()) == {10**9} and list(bag.columns_by_field) == ["x", "Temp"]


WRITTEN_APART = [
    ("%d/%m/%Y", "%I:%M:%S %p"),
    ("%Y-%m-%d", "%H:%M:%S.%f"),
    ("%d.%m.%y", "%H:%M"),
    ("%d/%m/%Y", "%H.%M.%S"),
]


@pytest.mark.parametrize(("day", "clock"), WRITTEN_APART)
def test_days_beside_times_of_day_are_theirs(day, clock, tmp_path, capsys):
    """`init` took the day for the name of a run, as the time steps back at midnight, and ended in a traceback."""
    path, start = tmp_path / "a.csv", datetime(2024, 3, 13, 22)
    x, rows = 0.0, []
    for k in range(400):
        t = start + timedelta(minutes=k)
        u = float(k // 20 % 2)
        rows.append(f"{t.strftime(day)},{t.strftime(clock)},{u},{x + 0.01 * math.sin(7 * k):.4f}")
        x += 0.2 * (u - x)
    bag = read_csv(tmp_path, "Date,Time,cmd,x", rows)
    assert bag.times[0] == np.datetime64(start, "ns").astype(np.int64)
    assert set(np.diff(bag.times).tolist()) == {60 * 10**9}
    assert bag.warnings[0].startswith(f"{path}: column 'Time': its days are those of column 'Date'")
    assert main(["init", str(path)]) == 0 and "runs:" not in capsys.readouterr().out


@pytest.mark.parametrize("names", ["date,hour,x", "", "logged (txt),since (txt),x"])
def test_times_of_day_are_found_beside_days_whatever_they_are_called(names, tmp_path):
    """Of the days alone the rows of each came evenly, and without a header there was no time."""
    start = datetime(2026, 3, 13, 23)
    times = [start + timedelta(seconds=20 * k + k % 2) for k in range(400)]
    form = "%Y-%m-%d %H:%M:%S,2026-03-12 22:00:00" if "txt" in names else "%Y.%m.%d,%H:%M:%S"
    bag = read_csv(tmp_path, names, [f"{t.strftime(form)},{k % 7}.5" for k, t in enumerate(times)])
    assert bag.times.tolist() == [np.datetime64(t, "ns").astype(int) for t in times]
    assert len(bag.warnings) == ("txt" not in names) and "words" not in " ".join(propose([bag.path]).warnings)


def test_runs_that_are_named_as_no_file_is(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("lot,t,x\n" + "".join(f"7/{k // 40}[b],{k % 40},{k}\n" for k in range(80)))
    bags = group_recordings([path], layout=TableLayout(runs="lot"))
    assert [bag.path.name for bag in bags] == ["a.csv[7-0(b)]", "a.csv[7-1(b)]"]
    assert len(open_recording(tmp_path / "a.csv[7-1(b)]", layout=TableLayout(runs="lot")).times) == 40


def test_what_is_read_alike_in_many_columns_is_noted_once(tmp_path):
    bag = read_csv(tmp_path, "t;a;b;c", (f"{k};{k},5;{k};{k % 7},25" for k in range(40)))
    assert bag.warnings == [f"{bag.path}: columns 'a', 'c': decimal commas read as points"]


def test_cells_that_are_no_number_part_no_note_of_columns_that_are_read_alike(tmp_path):
    """Of three files of a plant with a few cells such as `Bad` were 22 notes, of which each had other columns."""
    rows = [[f"{k}", f"{k},5", f"{k},25", f"{k}"] for k in range(40)]
    rows[3][1], rows[5][1], rows[7][3] = "Bad", "No Data", "Bad"
    bag = read_csv(tmp_path, "t;a;b;c", map(";".join, rows))
    assert bag.warnings == [
        f"{bag.path}: columns 'a', 'b': decimal commas read as points",
        f"{bag.path}: columns 'a', 'c': 3 cells that are no number (such as 'Bad') left out",
    ]


def test_of_many_files_whose_days_may_be_months_one_note_says_how_they_are_read(tmp_path, capsys):
    for day in range(1, 5):
        rows = "".join(
            f"0{day}/04/2021 11:{k // 60:02}:{k % 60:02},{math.sin(k / 9):.4f},{k // 20 % 2}\n" for k in range(90)
        )
        (tmp_path / f"{day}.csv").write_text(f"Time,x,valve\n{rows}")
    files = [str(tmp_path / f"{day}.csv") for day in range(1, 5)]
    assert main(["init", *files, "--output", str(tmp_path / "s.yaml")]) == 0
    assert capsys.readouterr().err.count("taken for day, month, year") == 1


def test_noon_and_midnight_of_twelve_hours(tmp_path):
    hours = ["12:00 AM", "1:30 am", "12:00 PM", "1:30 pm", "11:59 p.m."]
    bag = read_csv(tmp_path, "time,x", (f"{hour},{k}" for k, hour in enumerate(hours)))
    assert (bag.times // (60 * 10**9)).tolist() == [0, 90, 720, 810, 1439]


def test_milliseconds_behind_a_dash_are_no_decimals(tmp_path):
    """The telemetry of a rocket writes -34 for 34 ms; no such time was read."""
    rows = [f"2022-5-7--11-24-{24 + k // 1000}-{k % 1000},{k % 7}" for k in range(0, 9000, 34)]
    assert set(np.diff(read_csv(tmp_path, "Time,x", rows).times).tolist()) == {34 * 10**6}


def test_a_time_that_cannot_be_read_is_named_and_no_temperature_taken_for_it(tmp_path):
    rows = [f"2024-03-13 11:55:{k:02} IST,{k % 5},{20 + k % 7}" for k in range(60)]
    words = "column 'Timestamp': '2024-03-13 11:55:00 IST' in row 1 is neither a number nor"
    refuses(BagError, words, read_csv, tmp_path, "Timestamp,x,T", rows)
    bag = read_csv(tmp_path, "Timestamp,t,x", (f"shift {k % 3},{0.1 * k},{k % 5}" for k in range(60)))
    assert set(np.diff(bag.times).tolist()) == {10**8}


def test_what_is_odd_in_a_table_of_the_office_is_read_or_told(tmp_path):
    """Newest rows first, whole seconds, days of a spreadsheet, the letters of Windows, a row for each number."""
    for day in ("", "12/01/2014 "):
        newest = read_csv(tmp_path, "time,x", (f"{day}00:{40 - k}:00,{k}" for k in range(30)))
        assert set(np.diff(newest.times).tolist()) == {60 * 10**9} and newest.columns_by_field["x"][0] == 29
        assert "newest row comes first" in newest.warnings[-1]
    for head, rows, words in (
        (
            "time,x",
            (f"{k // 10},{k % 10}" for k in range(100)),
            "90 of 100 rows have the time of a row before in column 'time', and only.*or take another, `--table time=",
        ),
        ("Date,x", (f"{45717 + k / 300:.6f},{k}" for k in range(9)), "write days of a spreadsheet"),
    ):
        assert re.search(words, " ".join(read_csv(tmp_path, head, rows).warnings))
    assert not read_csv(tmp_path, "time,x", (f"{45717 + k / 50:.3f},{k}" for k in range(9))).warnings  # since the boot
    assert list(read_csv(tmp_path, "time,Größe °C", ["0,1", "1,2"], "cp1252").columns_by_field) == ["Größe_C"]
    rows = read_csv(tmp_path, "time,signal,value", (f"{k},{('a', 'a', 'b')[k % 3]},{k * k}" for k in range(90)))
    assert "names the signal of a row's one number, and they come at times of" in rows.topics["/table"].reason
    rows = read_csv(tmp_path, "time,axle,value", (f"{k},{('front', 'rear')[k % 2]},{k * k}" for k in range(90)))
    assert "write a column for each signal, or call it `signal`" in rows.topics["/table"].reason


def _of_tags(form, late=0.0):
    """Rows of a level and a valve, 20 s apart, as a historian writes them."""
    return [form.format(t=20 * k + late * i, tag=tag, i=i, x=x) for k in range(60)
            for i, (tag, x) in enumerate((("LT1.PV", k % 7), ("V1/OP", 5)))]  # fmt: skip


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("TagName,time,Value,Quality", _of_tags("{tag},{t},{x},Good")),
        ("TagName,time,Value", ["", *_of_tags("{tag},{t},{x}")[::-1]]),
        ("ID,Name,time,Value", _of_tags("0x{i},{tag},{t:.3f},{x}", 0.004)),
        (",result,table,time,_value,_field", sorted(_of_tags(",,{i},{t:04},{x},{tag}"))),
        ("Time,Series,Value", _of_tags("{t},{tag},{x}")),  # of Grafana
        ("timestamp,topic,payload", _of_tags("{t},{tag},{x}")),  # of Node-RED
    ],
)
def test_rows_of_one_number_each_are_put_side_by_side(header, rows, tmp_path):
    """A historian's tags, messages of a bus, each a little later than the other, and blocks one after the other."""
    bag = read_csv(tmp_path, header, rows)
    assert {**bag.columns_by_field}.keys() == {"LT1_PV", "V1_OP"} and set(np.diff(bag.times).tolist()) == {20 * 10**9}
    np.testing.assert_array_equal(bag.columns_by_field["LT1_PV"], [k % 7 for k in range(60)])
    np.testing.assert_array_equal(bag.columns_by_field["V1_OP"], 5)
    assert "names the signal of each number in" in bag.warnings[-1]


def test_the_archive_of_a_panel_is_read(tmp_path):
    """WinCC: `Time_ms`, days in millionths, was the time in ms, and its last line the one row of a signal."""
    rows = [f'"{tag}";"08.11.2026 11:{k // 60:02}:{k % 60:02}";{x};1;{46334458333.3 + k / 0.0864:.3f}'
            for k in range(90) for tag, x in (("LT1", k % 7), ("V1", k // 50))]  # fmt: skip
    header = '"VarName";"TimeString";"VarValue";"Validity";"Time_ms"'
    bag = read_csv(tmp_path, header, [*rows, '"$RT_COUNT$";180;;;'])
    assert {name: column[-1] for name, column in bag.columns_by_field.items()} == {"LT1": 5, "V1": 1}
    assert set(np.diff(bag.times).tolist()) == {10**9}


def test_signals_one_after_the_other_that_do_not_come_together_are_no_runs(tmp_path):
    """The history of Home Assistant: all of its numbers were one state of as many runs, without a word."""
    rows = [f"sensor.{name},{k % 7},2026-11-08T11:00:{k % 60:02}.{ms}Z" for name, ms, every in
            (("p", 100, 1), ("q", 200, 2)) for k in range(0, 60, every)]  # fmt: skip
    path = tmp_path / "history.csv"
    path.write_text("\n".join(["entity_id,state,last_changed", *rows]) + "\n")
    words = "column 'entity_id' names the signal of a row's one number, and they come at times of their"
    refuses(BagError, words, propose, [path])


def test_the_log_of_a_car_polled_in_turn_has_a_topic_for_each_turn(tmp_path):
    """Of an app: `PID` names what a row is of, some come together and others not. `SECONDS` of the day were none."""
    turns = ((0.0, ("Engine RPM",)), (0.3, ("MAF", "Power from MAF")), (0.7, ("Coolant",)))
    rows = [f'"{46100 + k + late:.6f}";"{name}";"{math.sin(k + i):.5f}";"-";' for k in range(90)
            for late, names in turns[: 3 - k % 2] for i, name in enumerate(names)]  # fmt: skip
    bag = read_csv(tmp_path, '"SECONDS";"PID";"VALUE";"UNITS";', rows)
    assert {topic: info.count for topic, info in bag.topics.items()} == {
        "/table/Engine": 90, "/table/MAF": 90, "/table/Coolant": 45}  # fmt: skip
    assert bag.facts()[0].rate == pytest.approx(1) and "'PID' names the signal of each number" in bag.warnings[0]
    bag = read_csv(tmp_path, "SECONDS,x", (f"{66724.0473 + (k // 3) ** 1.1 * 0.31:.6f},{k}" for k in range(90)))
    assert np.ptp(bag.times) * 1e-9 == pytest.approx(29**1.1 * 0.31, rel=0.05)  # said: may be s or days


def _of_influx(fields, tag=""):
    """A table of each field with what InfluxDB writes above those of one type, a minute of 1 s."""
    for i, (name, cells) in enumerate(fields):
        kind = "double" if cells[0].isdigit() else "boolean"
        above = f"#group,false,false,false,false,true,true|#datatype,string,long,dateTime:RFC3339,{kind},string,string|"
        yield from (f"{above}#default,_result,,,,,|,result,table,_time,_value,_field,unit").split("|")
        yield from (f",,{i},2026-11-03T06:00:{k:02}Z,{cell},{name},{tag or 'K'}" for k, cell in enumerate(cells))
        yield ""


def test_a_file_of_influxdb_with_numbers_of_several_types_is_read(tmp_path):
    """What is above the second table was taken for rows, and `_time` was no time."""
    fields = [("p", [str(k % 7) for k in range(60)]), ("on", ["true", "false"] * 30)]
    first, *rest = _of_influx(fields)
    bag = read_csv(tmp_path, first, rest)
    found = {name: column.tolist() for name, column in bag.columns_by_field.items()}
    assert found == {"p": [k % 7 for k in range(60)], "on": [1, 0] * 30} and len(bag.times) == 60


def test_numbers_of_one_name_and_time_are_of_the_units_that_another_column_names(tmp_path):
    """Of two compressors with fields of the same names the second one was lost without a word."""
    rows = [f"{k},{unit},{name},{k % 7 + i}" for k in range(60)
            for i, (unit, name) in enumerate([("K1", "p"), ("K1", "q"), ("K2", "p"), ("K2", "q")])]  # fmt: skip
    found = read_csv(tmp_path, "time,unit,_field,_value", rows).columns_by_field
    assert {name: column[0] for name, column in found.items()} == {"K1_p": 0, "K1_q": 1, "K2_p": 2, "K2_q": 3}


@pytest.mark.parametrize("by", ["time", "tag"])
def test_a_number_beside_that_named_value_is_a_quality_or_of_a_unit(tmp_path, by):
    """Sorted by tags all were one state of as many runs, without a word."""
    rows = [(k, f"{tag},{k % 7},{192 - k % 40 // 39}") for k in range(80) for tag in ("p", "q")]
    rows = [f"{k},{cells}" for k, cells in (rows if by == "time" else sorted(rows, key=lambda row: row[1][0]))]
    assert {*read_csv(tmp_path, "time,tag,value,quality", rows).columns_by_field} == {"p", "q"}
    rows = [f"{k},{unit},{tag},{k % 7 + unit}" for k in range(60) for unit in (1, 2) for tag in ("p", "q")]
    found = read_csv(tmp_path, "time,unit,tag,value", rows).columns_by_field
    assert {name: column[0] for name, column in found.items()} == {"c_1_p": 1, "c_1_q": 1, "c_2_p": 2, "c_2_q": 2}


def test_what_is_not_put_side_by_side_is_counted_and_no_name_takes_the_place_of_another(tmp_path):
    """Rows without a name had all tags read as runs of one state; those without a time, and a tag `time`, were lost."""
    rows = [f"{k},{tag},{k % 7}" for tag in ("p", "time") for k in range(60)]
    rows[5], rows[70] = ",p,5", "10,,3"
    bag = read_csv(tmp_path, "time,tag,value", [*rows, "4,p,9"])
    assert {name: int(np.isfinite(c).sum()) for name, c in bag.columns_by_field.items()} == {"p": 59, "time_2": 59}
    assert "3 rows left out without a name, a time or a number" in bag.warnings[-1]
    units = [f"{k},{unit},{tag},{k % 7}" for k in range(60) for unit, tag in (("a", "b_c"), ("a_b", "c"), ("a", "c"))]
    assert len(read_csv(tmp_path, "time,unit,tag,value", units).columns_by_field) == 3
    refuses(BagError, "column 'tag' names the signal", propose, [write(tmp_path / "r.csv", "time,tag,value", "7,z,1",
            *(f"{k},{tag},{k % 7}" for tag in ("p", "q") for k in range(60)))])  # fmt: skip


def test_a_signal_that_lacks_some_times_is_missing_there(tmp_path):
    rows = [row for k, row in enumerate(_of_tags("{tag},{t},{x}")) if k not in (10, 33)]
    bag = read_csv(tmp_path, "tag,time,value", rows)
    missing = {name: np.flatnonzero(np.isnan(column)).tolist() for name, column in bag.columns_by_field.items()}
    assert missing == {"LT1_PV": [5], "V1_OP": [16]} and len(bag.times) == 60


def test_a_driver_who_is_named_in_each_row_is_no_signal(tmp_path):
    rows = (f"{k},{k % 7},{('Ann', 'Bo')[k // 50]}" for k in range(100))
    assert list(read_csv(tmp_path, "time,speed,name", rows).columns_by_field) == ["speed", "name"]


def test_names_above_the_rows_are_no_comments_where_there_are_other_names(tmp_path):
    """Of a file of InfluxDB the kinds of numbers were the names."""
    above = ["#group,false,false,true", "#datatype,dateTime:RFC3339,double,double", "#default,,,", "_time,x,y"]
    rows = [f"2026-03-01T08:00:{k:02}Z,{k % 7},{k % 5}" for k in range(50)]
    assert list(read_csv(tmp_path, above[0], [*above[1:], *rows]).columns_by_field) == ["x", "y"]
    assert list(read_csv(tmp_path, "# time,x", (f"{k},{k % 7}" for k in range(50))).columns_by_field) == ["x"]


ROWS = [f"{k / 10},{k % 7},{k % 5}" for k in range(50)]


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        (['time,"x\n[m/s, mean]","y\n\n[V]"', *ROWS], ["x_m_s_mean", "y_V"]),  # Alt and Enter in a spreadsheet
        (["time,x,y", *(f"{row},,," for row in ROWS)], ["x", "y"]),
        (["time,x,y", *ROWS[:25], "\ufefftime,x,y", *ROWS[25:]], ["x", "y"]),  # one file put behind another
        (["time,x,y", *ROWS, "\0" * 4096], ["x", "y"]),  # after a power cut
        (["time,x,y", *ROWS[:25], "\0" * 134 + ROWS[25], *ROWS[26:]], ["x", "y"]),  # and of a log that went on
        (["time,x,y", *ROWS[:25], "2.5,4" + "\0" * 4096 + ROWS[25], *ROWS[26:]], ["x", "y"]),  # in a cut line
        (['"Format","MoTeC CSV File",,,"Workbook",""', '"Rate","20.0","Hz"', "", "time,x,y", *ROWS], ["x", "y"]),
    ],
)
def test_names_in_several_lines_and_what_is_behind_rows_and_files_cost_no_row(text, fields, tmp_path):
    bag = read_csv(tmp_path, text[0], text[1:])
    assert list(bag.columns_by_field) == fields
    assert bag.columns_by_field[fields[0]].tolist() == [k % 7 for k in range(50)]
    assert bag.times.tolist() == [k * 10**8 for k in range(50)]


def test_a_first_row_with_a_cell_that_is_too_long_is_not_passed_over(tmp_path):
    rows = [f"0,1,{'y' * 200_000}", *(f"{k},{k % 7},z" for k in range(1, 50))]
    assert len(read_csv(tmp_path, "time,x,note", rows).times) == 50
    with pytest.raises(BagError, match=r"line 2 cannot be read \(field larger than field limit"):
        read_csv(tmp_path, "time,x,note", [*rows, "50,1"])  # which is looked at line by line


CELLS = [
    "1.5",
    "-2e3",
    "",
    "NA",
    "nan",
    "on",
    "off",
    "7 rpm",
    "1,5",
    '"1,234.5"',
    "1.234",
    "1_0",
    '"a ""b"" c"',
    "\u22123",
    " 4 ",
]


@settings(max_examples=150, deadline=None)
@given(
    delimiter=st.sampled_from([",", ";", "\t"]),
    odd=st.lists(st.tuples(*[st.sampled_from(CELLS)] * 3), min_size=1, max_size=4),
)
def test_a_file_read_at_once_is_that_read_line_by_line(tmp_path, delimiter, odd):
    """A line that is cut at the end has each looked at; cells that are no plain numbers come late in the file."""
    rows = [("time", "a", "b", "c"), *((f"2026-03-01 00:00:{k:02}", "1", f"{k / 7}", "on") for k in range(45))]
    rows += [(f"2026-03-01 00:01:{k:02}", *cells) for k, cells in enumerate(odd)]
    quoted = ((f'"{cell}"' if delimiter in cell and '"' not in cell else cell for cell in row) for row in rows)
    lines = [*map(delimiter.join, quoted)]
    found = [read_table(write(tmp_path / "a.csv", *lines, *cut)) for cut in ([], ["9"])]
    assert [*found[0].columns] == [*found[1].columns] and found[0].notes == found[1].notes[1:]
    for one, other in zip(*(table.columns.values() for table in found), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_blank_before_a_quote_or_behind_the_last_delimiter_changes_nothing(tmp_path):
    """Numbers in such quotes were lost where the first rows had none, and text kept its quotes."""
    rows = [f"2026-03-01 00:{k // 60:02}:{k % 60:02},{k},on,{k}," for k in range(80)]
    table = read_table(write(tmp_path / "a.csv", "time,x,mode,y", *rows, '2026-03-01 00:01:20, "80", "off",80,  '))
    assert table.columns["x"].tolist() == [*range(81)] and table.columns["mode"].tolist() == [1] * 80 + [0]
    assert [*table.columns] == ["time", "x", "mode", "y"] and not table.notes


def test_a_parquet_without_rows_or_with_a_name_twice(pa, tmp_path):
    of_50 = [
        pa.array(range(50), pa.float64()),
        pa.array([k % 7 for k in range(50)]),
        pa.array([k % 5 for k in range(50)]),
    ]
    pa.parquet.write_table(table := pa.Table.from_arrays(of_50, names=["time", "x", "x"]), tmp_path / "a.parquet")
    assert read_table(tmp_path / "a.parquet").columns["x 2"].tolist()[:6] == [0, 1, 2, 3, 4, 0]
    pa.parquet.write_table(table.slice(0, 0), tmp_path / "b.parquet")
    with pytest.raises(BagError, match="has columns and no row; record or copy it again"):
        read_table(tmp_path / "b.parquet")


def test_an_array_of_structures_has_a_row_in_each_and_durations_are_seconds():
    """As `log(k).time = ...` of MATLAB makes it, and numpy writes a time."""
    read = _of_arrays(Path("a.mat"), {"log": [{"time": k / 10, "x": k % 7, "mode": "auto"} for k in range(50)]})
    assert list(read.columns) == ["log_time", "log_x", "log_mode"] and read.columns["log_x"].tolist()[:9:8] == [0, 1]
    read = _of_arrays(Path("a.npz"), {"time": np.arange(50).astype("timedelta64[ms]"), "x": np.arange(50) % 7})
    assert read.columns["time"].tolist()[:3] == [0.0, 0.001, 0.002]


@pytest.mark.parametrize("header", ["sec,nanosec,frame,x", "stamp_secs,stamp_nsecs,frame,x", ""])
def test_the_stamp_of_a_message_in_two_columns_is_the_time(header, tmp_path):
    """As `ros2 topic echo --csv` writes it, without names; seconds alone made rows of a second even."""
    stamps = [1_790_000_000_300_000_007 + 20_000_000 * k + 1000 * (k % 3) for k in range(200)]
    rows = [f"{t // 10**9},{t % 10**9},base,{k % 7}" for k, t in enumerate(stamps)]
    (tmp_path / "a.csv").write_text("\n".join([*filter(None, [header]), *rows]))
    bag = open_recording(tmp_path / "a.csv")
    assert bag.times.tolist() == stamps and not bag.warnings
    encoder = read_csv(tmp_path, "sec,ticks,x", (f"{t // 10**9},{k * 4_000_000},{k % 7}" for k, t in enumerate(stamps)))
    assert "ticks" in encoder.columns_by_field


def test_a_measurement_of_labview_is_a_table(tmp_path):
    above = ["LabVIEW Measurement", "Separator\tTab", "Date\t2026/03/01", "***End_of_Header***", "", "Channels\t2"]
    above += ["Samples\t60\t60", "***End_of_Header***", "X_Value\tspeed\tvalve\tComment"]
    (tmp_path / "a.lvm").write_text("\n".join([*above, *(f"{k / 10:.6f}\t{k % 7}\t{k % 5}\t" for k in range(60))]))
    bag = open_recording(tmp_path / "a.lvm")
    assert list(bag.columns_by_field)[:2] == ["speed", "valve"] and set(np.diff(bag.times).tolist()) == {10**8}


def test_a_day_ends_at_24(tmp_path):
    hours = [f"2026-03-0{1 + k // 24} {k % 24 + 1:02}:00:00,{k}" for k in range(100)]
    assert set(np.diff(read_csv(tmp_path, "time,x", hours).times).tolist()) == {3600 * 10**9}
    late = ["2026-03-01T23:00+01:00,1", "2026-03-01T24:00+01:00,2"]
    assert np.diff(read_csv(tmp_path, "time,x", late).times).tolist() == [3600 * 10**9]
    refuses(BagError, "no day or time that there is", read_csv, tmp_path, "time,x", ["2026-03-01 24:01:00,1"])


SAID = {  # of a recording, by the historian of a plant and by the tool of a test rig
    "historian": ["Begin,09/12/2017 10:00,End,", ",PIC1/OUT,PIC1/PV,LI2/PV", "TIMESTAMP,Outlet,,Level"],
    "rig": ["user,admin", "", "types,5,4,4", "names,,Out1,Out1", "path,time,a/PIC1,b/LI2", "max,,1e9,1e9"],
}


@pytest.mark.parametrize("tool", SAID)
def test_names_are_found_below_what_a_tool_says_of_the_recording(tool, tmp_path):
    """Its lines with a number or an instant were the first data, so that no column had a name."""
    form = {"historian": "{t},{k},{x},{k}", "rig": ",{t},{x},{k}"}[tool]
    rows = (form.format(t=0.5 * k, k=k, x=k % 7) for k in range(50))
    bag = read_csv(tmp_path, SAID[tool][0], [*SAID[tool][1:], *rows])
    assert {"historian": "PIC1_PV", "rig": "a_PIC1"}[tool] in bag.columns_by_field
    assert len(bag.times) == 50 and set(np.diff(bag.times).tolist()) == {5 * 10**8}


@pytest.mark.parametrize(("first", "hour"), [(42990.41667, 10), (737045.41667, 10)])
def test_days_of_a_spreadsheet_are_read_where_they_are_said(first, hour, tmp_path):
    """A plant's rows a second apart were taken for 10^5 a second; now their unit is asked for."""
    rows = [f"{first + k / 86400:.5f},{k}" for k in range(400)]
    refuses(BagError, "may be s or days.*unit=d", read_csv, tmp_path, "time,x", rows)
    said = ("time,x", TableLayout(unit="d")), ("time (days),x", None), ("Date/Time,x", None), ("Time,Elapsed [s]", None)
    for head, layout in said:  # the last by the seconds beside it
        (tmp_path / "a.csv").write_text("\n".join([head, *rows]))
        (bag,) = group_recordings([tmp_path / "a.csv"], layout=layout or TableLayout())
        begin, end = (np.datetime64(int(t), "ns").astype("datetime64[s]") for t in bag.times[[0, -1]])
        assert str(begin)[10:13] == f"T{hour}" and abs(int((end - begin).astype(int)) - 399) <= 1
        assert str(begin)[:4] in ("2017", "2018")


@pytest.mark.parametrize(("seconds", "digits"), [(300, 10), (300, 5), (60, 5), (1, 10), (3600, 6)])
def test_days_on_the_clock_are_no_seconds(seconds, digits, tmp_path):
    """Rows of a greenhouse, 5 min apart by `GHtime` in days, had no time; with it named, they were at 288 Hz."""
    bag = read_csv(tmp_path, "x,GHtime", (f"{k},{43326 + k * seconds / 86_400:.{digits}f}" for k in range(50)))
    assert np.abs(np.diff(bag.times) * 1e-9 - seconds).max() < 1.0
    assert str(np.datetime64(int(bag.times[0]), "ns"))[:10] == "2018-08-14" and "are taken for d" in bag.warnings[0]
    for hertz in (1000, 162, 100, 60, 50, 30, 1):  # since the boot
        bag = read_csv(tmp_path, "time,x", (f"{43326.0003 + k / hertz:.4f},{k}" for k in range(50)))
        assert abs(np.median(np.diff(bag.times)) * 1e-9 * hertz - 1) < 0.1


def test_runs_of_the_same_times_are_not_all_compared_with_each_other(monkeypatch):
    """Of 10 000 runs of 20 rows that took longer than the fit."""
    t, compared = np.arange(20) * 10**9, []
    runs = [Transient(t, np.random.default_rng(k).normal(size=(20, 2)), np.zeros((20, 1))) for k in range(60)]
    monkeypatch.setattr(np, "array_equal", lambda *some, **how: compared.append(1) or False)
    refuse_copies(runs)
    assert len(compared) < len(runs)
    monkeypatch.undo()
    refuses(BagError, "holds the samples of", refuse_copies, [*runs, runs[7].replace(x=runs[7].x.copy())])


def test_rows_of_whole_seconds_come_evenly_and_those_of_units_do_not(tmp_path):
    """Of a machine at 20 Hz, stamped in whole seconds, with a pause of five; units of another one are no rows of it."""
    t = 1.7e9 + 0.35 + np.concatenate([np.arange(0, 10, 0.05), np.arange(15, 25, 0.05)])
    bag = read_csv(tmp_path, "time,x,y", (f"{math.floor(s)},{math.sin(s):.6f},{s % 7:.3f}" for s in t))
    assert np.abs(np.diff(bag.times) * 1e-9 - np.diff(t)).max() < 0.06 and np.abs(bag.times * 1e-9 - t).max() < 0.06
    assert "taken to come evenly in the 1 s after it" in bag.warnings[0]
    polled = read_csv(tmp_path, "time,x,y", (f"{k // 4},{k // 4 % 9},{(k - 2) // 4 % 7}" for k in range(400)))
    assert np.unique(polled.times).size == 100  # of four rows, each of which has one new number
    units = read_csv(
        tmp_path, "time,x,y", (f"{k // 20},{k % 20 + k // 20 / 9},{k % 20 * 3 - k // 20}" for k in range(400))
    )
    assert np.unique(units.times).size == 20 and "the 20 rows of a time one for each of 20 units" in units.warnings[0]


def test_rows_that_a_logger_wrote_several_times_count_once(tmp_path):
    """Each message five times, one of its columns at times without a number; said to be rows of five units."""
    rows = [f"{k // 5 / 4},{k // 5 % 7},{'' if k // 5 % 3 else k // 5},{'ab'[k // 50 % 2]}" for k in range(400)]
    bag = read_csv(tmp_path, "time,x,y,mode", rows)
    assert len(bag.times) == 80 and bag.facts()[0].rate == 4 and len(bag.columns_by_field["x"]) == 80
    assert "320 of 400 rows repeat the row before" in bag.warnings[0] and len(bag.warnings) == 1
    rows[7] = "0.25,9,1,a"
    assert len(read_csv(tmp_path, "time,x,y,mode", rows).times) == 400  # of one time there are two values


def test_the_time_of_an_office_or_a_tester_is_found_by_its_name(tmp_path):
    bag = read_csv(tmp_path, "Date/Time,x", (f"01 01 2018 00:{k:02},{k}" for k in range(30)))
    assert set(np.diff(bag.times).tolist()) == {60 * 10**9}
    bag = read_csv(tmp_path, "x,Test_Time(s)", (f"{k % 7},{2.5 * k}" for k in range(30)))
    assert set(np.diff(bag.times).tolist()) == {25 * 10**8} and "grows from row to row" in bag.warnings[0]
    with pytest.raises(BagError, match="column 'Messzeitpunkt' holds 'shift 0', which is not read as a time, and no"):
        read_csv(tmp_path, "x,Messzeitpunkt", (f"{k % 7},shift {k}" for k in range(30)))


@pytest.mark.parametrize("time", ["Zeit", "Messzeit", "Time", "Vorgang"])
def test_a_temperature_is_no_time_whatever_the_time_is_called(tmp_path, time):
    """`T_Oel` of a test stand was the time beside `Zeit`: half of the rows were older than the row before."""
    rows = (f"{k / 10},{90 + 3 * math.sin(k / 4):.2f},{k % 7}" for k in range(60))
    bag = read_csv(tmp_path, f"{time},T_Oel,x", rows)
    assert set(np.diff(bag.times).tolist()) == {10**8} and set(bag.columns_by_field) >= {"T_Oel", "x"}


@pytest.mark.parametrize("odd", ["", "-", "#NAME?"])
@pytest.mark.parametrize("form", ["{m:02}:{s:02}.0", "13/01/14 12:{m:02}:{s:02}", "2024-03-13 12:{m:02}:{s:02}"])
def test_a_cell_that_is_no_time_among_many_that_are_is_left_out_and_named(tmp_path, form, odd):
    """Beyond the hour as well, where minutes and seconds alone begin again; where many are odd, all are refused."""
    every = [form.format(m=(30 + k // 2) % 60, s=k % 2 * 30) for k in range(55 if "12:" in form else 100)]
    bag = read_csv(tmp_path, "time,x", (f"{odd if k == 20 else cell},{k}" for k, cell in enumerate(every)))
    assert bag.columns_by_field["x"].tolist() == [k for k in range(len(every)) if k != 20]
    assert sorted(np.diff(bag.times).tolist()) == [30 * 10**9] * (len(every) - 3) + [60 * 10**9]
    assert any(f"1 cell that is no time (such as '{odd}') left out" in text for text in bag.warnings) == bool(odd)
    half = (f"{'-' if k % 2 else cell},{k}" for k, cell in enumerate(every))
    refuses(BagError, "is neither a number nor", read_csv, tmp_path, "time,x", half)


@pytest.mark.parametrize(
    ("name", "unit"), [("Time (min)", 60.0), ("t [h]", 3600.0), ("tempo_ms", 1e-3), ("zeit_s", 1.0), ("TimeUS", 1e-6)]
)
def test_a_time_says_its_unit_behind_its_name_in_any_language(name, unit, tmp_path):
    """`Time (min)` was read as seconds, and `tempo_ms` was found only where it came first and never fell."""
    bag = read_csv(tmp_path, f"x,{name}", (f"{k % 7},{k % 20}" for k in range(40)))
    assert np.median(np.diff(bag.times)) == round(unit * 1e9) and list(bag.columns_by_field) == ["x"]


def test_a_day_above_twelve_says_the_order_where_the_clock_is_put_back(tmp_path):
    days = [f"{31 - (k < 8)}/10/2021 {(k % 8) // 4 + 2:02}:{15 * (k % 4):02},{k}" for k in range(16)]
    bag = read_csv(tmp_path, "time,x", [*days, *days[-4:]])
    assert (
        bag.times[0] == np.datetime64("2021-10-30T02:00", "ns").astype(np.int64) and (np.diff(bag.times) < 0).sum() == 1
    )


def test_names_that_are_repeated_between_the_rows_are_left_out_and_told(tmp_path):
    bag = read_csv(tmp_path, "time,x", (f"{k},{k % 7}" if k % 20 else "time,x" for k in range(1, 50)))
    assert (
        bag.warnings == [f"{bag.path}: 2 lines left out that repeat the names of the columns"] and len(bag.times) == 47
    )


def test_a_second_table_below_the_first_is_not_read_as_its_rows(tmp_path):
    """Its pressure went on as the speed of the first."""
    rows = [f"{k},{k % 7},{k % 5}" for k in range(30)]
    with pytest.raises(BagError, match="line 32 names other columns"):
        read_csv(tmp_path, "time,speed,temp", [*rows, "time,pressure,flow", *rows])


def test_signals_have_the_length_of_a_recording_and_not_that_of_its_parameters(tmp_path):
    """Of a robot's file with 24 parameters of six joints each joint was a row, and there was no time."""
    parameters = {f"p{i}": np.arange(6.0) + i for i in range(9)}
    t, q = 0.004 * np.arange(250), np.random.default_rng(0).normal(size=(6, 250))
    np.savez(tmp_path / "a.npz", **parameters, rec_time=t, q=q, v=q)
    bag = open_recording(tmp_path / "a.npz")
    assert bag.facts()[0].fields == ("q[0..5]", "v[0..5]") and len(bag.times) == 250
    assert (
        len(bag.warnings) == 2 and "'p0 (6)', 'p1 (6)'" in bag.warnings[0] and "not of 250 entries" in bag.warnings[0]
    )


def test_cells_of_several_numbers_are_told(tmp_path):
    """Two pressures and a clock in one quoted cell were gone without a word, and a temperature with its unit."""
    bag = read_csv(
        tmp_path,
        "time,x,raw,at,say,inlet",
        (f'{k},{k % 7},"1.0{k % 9},2.54,59{k}",2026-11-22 06:28:00,3 ok,2{k}.5 °C' for k in range(9)),
    )
    of_unit, said = bag.warnings
    assert "column 'raw' left out" in said and "number alone, such as '1.00,2.54,590': write one in each" in said
    assert "column 'inlet': '°C' taken off each number" in of_unit
    np.testing.assert_array_equal(bag.columns_by_field["inlet"], 20.5 + np.arange(9))
    mixed = read_csv(tmp_path, "time,x,flow", (f"{k},{k % 7},{k + 1} {('k', 'M')[k % 2]}" for k in range(9)))
    assert mixed.columns_by_field["flow"].dtype.kind == "O"
    bag = read_csv(tmp_path, "time,x", [f'{k},"{1000 + k:,}"' if k > 200 else f"{k},{k}" for k in range(500)])
    assert "column 'x' left out" in bag.warnings[0] and "such as '1,2" in bag.warnings[0]


def test_a_table_in_which_nothing_is_a_state_is_refused_with_what_was_left_out(tmp_path):
    (tmp_path / "a.csv").write_text("t,speed\n" + "".join(f'{k},"1,0{k % 90 + 10}"\n' for k in range(200)))
    with pytest.raises(BagError, match=r"nothing in it looks like .*column 'speed' left out.* such as '1,010'"):
        propose([str(tmp_path / "a.csv")])


def test_rows_out_of_order_are_told(tmp_path):
    bag = read_csv(tmp_path, "time,x", (f"{k * 7 % 20},{k % 3}" for k in range(20)))
    assert "6 of 20 rows are older than the row before: sort the rows by 'time', or name" in bag.warnings[-1]


def test_runs_in_a_table_may_step_back_before_the_first(tmp_path):
    """The newer half came first, so that no time passed from the first row to the last, and nothing was proposed."""
    rng, x, rows = np.random.default_rng(0), 0.0, []
    for k in range(800):
        rows.append(f"{0.02 * (k + 800 * (k < 400)):.2f},{x},{(u := k // 37 % 2)}")
        x += 0.1 * (u - x) + 0.001 * rng.normal()
    (tmp_path / "a.csv").write_text("\n".join(["t,speed,command", *rows, ""]))
    assert [c.name for c in propose([str(tmp_path / "a.csv")]).states] == ["speed"]


def test_names_that_fit_the_rows_are_theirs_and_not_older_ones_above(tmp_path):
    """Of a logger whose columns were changed after four rows, all later rows had the first names, one to the left."""
    rows = [f"{k}|{k % 3}|{k % 5}|7|" for k in range(40)]
    bag = read_csv(tmp_path, "time|speed|level|", ["0|1|2|", "", "time|flow|speed|level|", *rows])
    assert list(bag.columns_by_field) == ["flow", "speed", "level"] and len(bag.times) == 40


@pytest.mark.parametrize("tall", [False, True])
def test_a_matrix_whose_first_line_grows_has_its_time_there(tall, tmp_path):
    """As `To File` of Simulink writes it; no file of it could be read."""
    lines = np.vstack([0.002 * np.arange(50), np.sin(np.arange(50)), np.cos(np.arange(50))])
    np.savez(tmp_path / "a.npz", data=lines.T if tall else lines)
    bag = open_recording(tmp_path / "a.npz")
    assert bag.facts()[0].fields == ("data[0..1]",) and bag.facts()[0].rate == pytest.approx(500.0)
    np.savez(tmp_path / "b.npz", data=lines[1:])
    refuses(BagError, "no column is called time", open_recording, tmp_path / "b.npz")


@pytest.mark.parametrize("header", ["  Time   ref  lev2  lev1", "  Time   ref  Func. Gen.  lev1"])
def test_a_title_of_as_many_words_is_no_header(header, tmp_path):
    """Of the export of a laboratory's bench the columns were called after the program that wrote it."""
    rows = [f"  {k / 10:.2f}  {k % 7}  {k % 5}  {k % 3}" for k in range(60)]
    (tmp_path / "a.txt").write_text("\n".join(["Data of TecBench CE2", "", header, *rows]))
    bag = open_recording(tmp_path / "a.txt")
    fits = len(header.split()) == 4
    assert list(bag.columns_by_field) == (["ref", "lev2", "lev1"] if fits else ["column_2", "column_3", "column_4"])
    assert fits or "names 5 columns and its rows have 4 cells" in bag.warnings[0]


@pytest.mark.parametrize("stated", ["# Columnas: t y i u", "% columns of it: t, y,i, u", "# Columns: t y"])
def test_names_that_a_comment_states_are_those_of_the_columns(stated, tmp_path):
    """Nothing had a name, and the command was not told from what answers it."""
    rows = [f"{k / 100:.2f}\t{k % 7}\t{k % 5}\t{k % 3}" for k in range(60)]
    (tmp_path / "a.txt").write_text(
        "\n".join(["# Ts: 0.01s", stated, "# Model: a=1, b=2, c=3, d=4", "# By: Ada of Old York", "#", *rows])
    )
    names = list(open_recording(tmp_path / "a.txt").columns_by_field)
    assert names == (["y", "i", "u"] if "u" in stated.split()[-1] else ["column_2", "column_3", "column_4"])


@pytest.mark.parametrize("beside", [{}, {"t": 0.5 * np.arange(50)}])
def test_the_time_is_in_a_matrix_where_no_vector_beside_it_is_one(beside, tmp_path):
    """Of a motor, beside what was computed from it and the parameters, the file could not be read."""
    lines = np.vstack([0.002 * np.arange(50), np.sin(np.arange(50)), np.cos(np.arange(50))])
    others = {"gain": np.array([1.0, 2.0, 3.0]), "torque": np.sin(0.3 * np.arange(50))}
    np.savez(tmp_path / "a.npz", **others, data=lines.T, **beside)
    bag = open_recording(tmp_path / "a.npz")
    assert bag.facts()[0].rate == pytest.approx(2.0 if beside else 500.0)
    assert set(bag.facts()[0].fields) == {"torque", "data[0..2]" if beside else "data[0..1]"}


def test_how_long_something_has_lasted_is_no_time_where_many_rows_share_it(tmp_path):
    """Of a car at 1 Hz, `Time since codes cleared` in min made 60 rows a second."""
    rows = [f"{k},{424 + k // 60},{k % 7}" for k in range(300)]
    words = "'Time since codes cleared' says how long something has lasted, and no other is called time"
    refuses(BagError, words, read_csv, tmp_path, "index,Time since codes cleared,x", rows)
    bag = read_csv(tmp_path, "time_since_boot_ms,x", (f"{20 * k},{k % 7}" for k in range(90)))
    assert set(np.diff(bag.times).tolist()) == {20 * 10**6}


def test_a_step_beside_the_columns_is_named_for_rows_without_a_time(tmp_path):
    rows = [f"{k % 7},{k % 5},{4 if k == 0 else ''}" for k in range(60)]
    refuses(BagError, "'Ts' is the same in all rows.*`--table step=4` ", read_csv, tmp_path, "u,y,Ts", rows)
    zero = [f"{k % 7},{k % 5},0" for k in range(60)]
    refuses(BagError, "'t' is the same in all rows.*`--table step=0.01` ", read_csv, tmp_path, "u,y,t", zero)


def test_times_since_1970_are_found_without_a_name_though_some_step_back(tmp_path):
    rows = [f"{1455208122.28 + k - 2.5 * (k % 40 == 9):.2f},{k % 7}" for k in range(100)]
    bag = read_csv(tmp_path, "column,x", rows)
    assert np.median(np.diff(bag.times)) == 10**9 and "taken for the time" in bag.warnings[0]
    refuses(BagError, "no column is called time", read_csv, tmp_path, "column,x", [row[3:] for row in rows])


def test_row_numbers_without_a_name_are_no_time(tmp_path):
    """Of a data frame at 20 Hz they made a plant of a row per second; without names above, they are all there is."""
    rows = [f"{k},{k % 7},{k % 5}" for k in range(60)]
    refuses(BagError, "no column is called time", read_csv, tmp_path, ",x,y", rows)
    (tmp_path / "b.csv").write_text("\n".join(rows))
    assert "a second a row; if it numbers the rows" in open_recording(tmp_path / "b.csv").warnings[0]


def test_numbers_of_rows_are_no_seconds(tmp_path):
    """Beside `elapsed` in s at 10 Hz they made a plant of a row per second."""
    rows = [f"{k},{k / 10:.1f},{k % 7}" for k in range(60)]
    assert set(np.diff(read_csv(tmp_path, "step,elapsed,x", rows).times).tolist()) == {10**8}
    refuses(BagError, "no column is called time", read_csv, tmp_path, "step,x,y", rows)
    kept = [row for k, row in enumerate(rows) if k % 20 < 17]  # those of a data frame with a gap here and there
    refuses(BagError, "no column is called time", read_csv, tmp_path, ",x,y", kept)
    assert "taken for the time" in read_csv(tmp_path, ",x,y", [f"{2 * k},{k % 7},0" for k in range(60)]).warnings[0]
    assert "taken for the time" in read_csv(tmp_path, "k,x", (f"{2 * k},{k % 7}" for k in range(60))).warnings[0]


def test_of_two_times_in_words_both_are_named(tmp_path):
    """Of cycles of a heating: of the first it said that it is not read as a time."""
    rows = (f"{k},2011-11-30 07:{k:02}:00,2011-11-30 07:{k:02}:30,{k % 7}" for k in range(60))
    words = "columns 'StartTime' and 'EndTime' hold times, and no column alone is called time.*`--table time=COLUMN`"
    refuses(BagError, words, read_csv, tmp_path, "id,StartTime,EndTime,kWh", rows)


@pytest.mark.filterwarnings("error")
def test_a_table_of_one_row_says_nothing_but_its_sentence(tmp_path):
    refuses(BagError, "there is no time zone", read_csv, tmp_path, "time,x", ["2026-11-22T06:28:01+99:99,1"])


def test_another_time_is_taken_where_most_rows_share_one(tmp_path):
    bag = read_csv(tmp_path, "Timestamp,x,t [ms]", (f"00:00:{k // 10:02},{k % 7},{100 * k}" for k in range(100)))
    assert set(np.diff(bag.times).tolist()) == {10**8} and "and 'Timestamp' does not" in bag.warnings[0]
    bag = read_csv(tmp_path, "time,x", (f"{k - k // 4},{k}" for k in range(100)))
    assert "only the first of such rows counts: write times" in bag.warnings[0]
    assert not read_csv(tmp_path, "time_s,x", (f"{45717 + k / 288:.6f},{k}" for k in range(9))).warnings


@pytest.mark.parametrize("name", ["Time of day", "time_of_day"])
def test_seconds_of_a_day_are_no_days(name, tmp_path):
    bag = read_csv(tmp_path, f"{name},x", (f"{45_000 + k / 10},{k % 7}" for k in range(50)))
    assert (bag.times[1:] - bag.times[:-1]).tolist() == [10**8] * 49
    bag = read_csv(tmp_path, f"{name},x", (f"{0.5 + k / 1000},{k % 7}" for k in range(50)))
    assert (bag.times[1] - bag.times[0]) * 1e-9 == pytest.approx(86.4)


@pytest.mark.parametrize("digits", ["02", ""])
def test_minutes_and_seconds_of_a_spreadsheet_go_on_after_the_hour(digits, tmp_path):
    rows = [f"{k // 150 % 60:{digits}}:{0.4 * (k % 150):04.1f},{k}" for k in range(18000)]
    bag = read_csv(tmp_path, "time,x", rows)
    assert set(np.diff(bag.times).tolist()) == {4 * 10**8} and not bag.warnings
    back = read_csv(tmp_path, "time,x", (f"{minute}:00.5,{k}" for k, minute in enumerate([40, 41, 42, 30, 31, 32])))
    assert (np.diff(back.times) // 10**9).tolist() == [60, 60, -720, 60, 60]  # a clock that is set, and no hour


@pytest.mark.parametrize(
    ("head", "step", "seconds", "words"),
    [
        ("time (millisec)", 5, 0.005, "taken for ms"),
        ("ms_today", 40, 0.04, "taken for ms"),
        ("us_since_boot", 2500, 0.0025, "taken for us"),
        ("timestamp", 90, 90.0, "or give `--table unit=ms` (in a signals file `table: {unit: ms}`)"),
        ("timestamp", 7200, 7200.0, ""),  # by the hour or so
        ("timestamp", 5, 5.0, "taken for s, 5 from row to row"),
        ("timestamp_s", 5, 5.0, ""),
        ("timestamp", 1, 1.0, ""),
    ],
)
def test_the_unit_of_a_clock_is_in_its_name_or_asked_for(head, step, seconds, words, tmp_path):
    """Microseconds since the boot made 34 s of a flight 398 days, and nothing said so."""
    bag = read_csv(tmp_path, f"{head},x", (f"{112574307 + step * k},{k % 7}" for k in range(60)))
    assert set(np.diff(bag.times).tolist()) == {round(seconds * 1e9)}
    assert words in " ".join(bag.warnings) and bool(bag.warnings) == bool(words)


def test_a_clock_whose_rows_are_far_apart_in_no_unit_is_refused_until_its_unit_is_given(tmp_path):
    """Of a quadrotor at 83 rows a second a plant's model was fitted, of a row in three hours."""
    rows = [f"{17 * k + k % 2},{k % 7}" for k in range(60)]
    refuses(BagError, "1[68] from row to row: has no unit.*--table unit=ms", read_csv, tmp_path, "t,x", rows)
    rows = [f"{112574307 + 11999 * k + k % 3},{k % 7}" for k in range(60)]
    refuses(BagError, "12000 from row to row: has no unit.*--table unit=us", read_csv, tmp_path, "timestamp,x", rows)
    (bag,) = group_recordings([tmp_path / "a.csv"], layout=TableLayout(unit="us"))
    assert np.median(np.diff(bag.times)) == 12_000_000
    rows = [f"{10**8 * k},{k % 7}" for k in range(60)]  # 10 a second, which us made a row in 100 s
    refuses(
        BagError, "100000000 from row to row: has no unit; name it time_ns, .*unit=ns", read_csv, tmp_path, "t,x", rows
    )
    polled = read_csv(tmp_path, "timestamp,x", (f"{1732860000 + 302 * k},{k % 7}" for k in range(60)))  # since 1970
    assert np.median(np.diff(polled.times)) == 302 * 10**9


def test_a_unit_that_is_taken_for_granted_is_that_of_later_recordings(tmp_path):
    """The second half of a log in seconds was asked for the unit by `check`, which has no option for it."""
    rng, x, rows = np.random.default_rng(1), 0.0, []
    for k in range(4000):
        u = float(k // 40 % 3)
        rows.append(f"{10 * k},{u},{x + rng.normal(0, 0.01):.4f}")
        x += 0.15 * (u - x)
    for name, some in (("a", rows[:2000]), ("b", rows[2000:])):
        write(tmp_path / f"{name}.csv", "time,cmd,x", *some)
    text = propose([tmp_path / "a.csv"]).text
    assert "unit: s" in text.splitlines()[text.splitlines().index("table:") + 1]
    (tmp_path / "a.yaml").write_text(text)
    (later,) = group_recordings([tmp_path / "b.csv"], layout=SignalMap.load(tmp_path / "a.yaml").table)
    assert later.times[0] == 20_000 * 10**9 and not later.warnings


@pytest.mark.parametrize("suffix", [".txt", ".dat", ".TXT"])
def test_the_name_of_a_text_file_with_numbers_does_not_matter(suffix, tmp_path):
    """As laboratories write them; what is no text is named."""
    path = tmp_path / f"a{suffix}"
    path.write_text("time;x\n" + "".join(f"{k};{k % 7},5\n" for k in range(40)))
    (bag,) = group_recordings([path])
    assert len(bag.times) == 40 and bag.columns_by_field["x"][1] == 1.5
    path.write_bytes(bytes(range(256)) * 20)
    refuses(BagError, "bytes that are no text", group_recordings, [path])


def test_seconds_of_a_minute_are_no_time(tmp_path):
    """Of a clock in several columns they alone were the time."""
    rows = [f"{9 + k // 3600},{k // 60 % 60},{k % 60},{k % 7}" for k in range(0, 900, 2)]
    refuses(BagError, "no column is called time", read_csv, tmp_path, "AREA,MIN,SEC,x", rows)
    assert not read_csv(tmp_path, "SEC,x", (f"{0.1 * k:.1f},{k % 7}" for k in range(60))).warnings


def test_units_whose_rows_take_turns_are_told(tmp_path):
    """Seven sensors of a greenhouse were one machine, whose state jumped from one to the next."""
    rng = np.random.default_rng(1)
    units = rng.choice(["a1", "b2", "c3"], 300)
    bag = read_csv(tmp_path, "time,unit,x,y", (f"{k},{unit},{k % 7},{k % 5}" for k, unit in enumerate(units)))
    assert "rows are of 3 'unit' by turns: if they are units, say so" in bag.warnings[0]
    for cells in (np.sort(units), np.where(units == "a1", "", units)):  # one after the other, or an event now and then
        assert not read_csv(tmp_path, "time,unit,x,y", (f"{k},{c},{k % 7},1" for k, c in enumerate(cells))).warnings


def test_years_of_two_digits_may_come_first(tmp_path):
    bag = read_csv(tmp_path, "time,x", (f"24-03-{10 + k // 24:02} {k % 24:02}:00,{k}" for k in range(72)))
    assert set(np.diff(bag.times).tolist()) == {3600 * 10**9}


def test_files_of_one_signal_each_of_the_same_time_are_said_to_be_no_recordings_one_after_another(tmp_path):
    for name, day in (("a", 1), ("b", 1), ("c", 2)):
        rows = "".join(f"2024-03-0{day} 00:{k:02}:00,{k}\n" for k in range(30))
        (tmp_path / f"{name}.csv").write_text("save_time,value\n" + rows)
    said = [" ".join(bag.warnings) for bag in group_recordings([tmp_path / f"{name}.csv" for name in "abc"])]
    assert ["if each of them is of another signal" in text for text in said] == [False, True, False]


@pytest.mark.parametrize(("dated", "field", "steady"), [(True, "x", 0), (True, "unwrap(x)", "auto"), (False, "x", 0)])
def test_recordings_that_share_samples_are_told(tmp_path, dated, field, steady):
    """As snapshots of one stretch do; runs that each begin at 0 may begin alike."""
    files, values = [], np.random.default_rng(3).uniform(-1, 1, (700, 2))
    for name, part in (("later", slice(200, 500)), ("first", slice(0, 300)), ("apart", slice(600, 700))):
        rows = [f"{k + 1.7e9 * dated:.1f},{x},{u}" for k, (x, u) in enumerate(values.tolist())][part]
        files.append(tmp_path / f"{name}.csv")
        files[-1].write_text("\n".join(["time_s,x,u", *rows]))
    signals = tmp_path / "signals.yaml"
    line = "{{name: {0}, topic: /table, field: {1}, steady: {2}, scale: 1}}"
    signals.write_text(f"states: [{line.format('x', field, steady)}]\ncontrols: [{line.format('u', 'u', 0)}]\n")
    notes = [n for t in read_transients(files, signals) for n in t.notes if "count twice" in n]
    assert len(notes) == dated
    assert all(f"100 of its 300 samples are those of {files[1]}" in n and n.startswith(f"{files[0]}") for n in notes)


def test_messages_by_turns_in_one_table_are_topics(tmp_path):
    """What a log of several messages in one table held was told to be filled downwards, and stood between its rows."""
    rows = []
    for k in range(100):
        roll = f"{math.sin(0.1 * k):.6f}"
        rows += [f"{0.1 * k:.2f},{roll},{k % 7},,,", f"{0.1 * k + 0.03:.2f},,,{1500 + k % 9},,"]
        rows += [f"{0.1 * k + 0.05:.2f},,,,{12 - 0.01 * k:.2f},"] * (k % 4 == 0)
    path = write(tmp_path / "a.csv", "timestamp,ATT.Roll,ATT.Pitch,RCOU.C1,BAT.Volt,BAT.Curr", *rows)
    table = open_recording(path)
    counts = {topic: info.count for topic, info in table.topics.items()}
    assert counts == {"/table/ATT": 100, "/table/RCOU": 100, "/table/BAT": 25}
    assert [fact.rate for fact in table.facts()] == pytest.approx([10.0, 10.0, 2.5])
    assert "BAT_Curr" in table.facts()[0].fields  # empty all through, and not forgotten
    paths = [[FieldPath("RCOU_C1")], [FieldPath("ATT_Roll")]]
    columns = table.columns(["/table/RCOU", "/table/ATT"], paths)
    assert columns.values[0][:, 0].tolist() == [1500 + k % 9 for k in range(100)]
    messages = table.messages(["/table/ATT", "/table/RCOU"])
    in_order = [(int(topic == "/table/ATT"), at) for topic, at, _ in messages]
    assert in_order == list(zip(columns.topic.tolist(), columns.arrival.tolist(), strict=True))
    refuses(BagError, "there is no topic /table; it has /table/ATT, /table/RCOU", table.columns, ["/table"], [[]])


def test_columns_that_lack_numbers_now_and_then_or_one_after_the_other_are_of_one_topic(tmp_path):
    rng = np.random.default_rng(1)
    lost = [",".join([f"{0.1 * k:.1f}", *np.where(rng.random(3) < 0.3, "", "1.5")]) for k in range(300)]
    halves = [f"{0.1 * k:.1f},{'2.5,,1' if k < 150 else ',3.5,1'}" for k in range(300)]
    changed = [f"{0.1 * k:.1f}," + ",".join(str(k) if j == k * k % 3 else "" for j in range(3)) for k in range(300)]
    for number, rows in enumerate((lost, halves, changed)):
        path = write(tmp_path / f"{number}.csv", "time,a,b,c", *rows)
        assert list(open_recording(path).topics) == ["/table"]


def test_signals_of_several_rates_in_one_table_are_topics_of_their_own(tmp_path):
    """A CAN log with a row for each frame of the fastest signal had only those of its signals proposed."""
    rng = np.random.default_rng(1)

    def row(k):
        lost = rng.random() < 0.02
        slow = f"{k % 7 if k % 500 != 3 else ''},{math.sin(0.01 * k):.4f}" if k % 5 == 3 and not lost else ","
        return f"{0.01 * k:.2f},{'' if lost else k % 5},{k % 3},{slow},{20 + k // 100 if k % 100 == 7 else ''}"

    for rows in (60, 250, 350, 3000):  # a model of long ones refused those of fewer than four slow messages
        path = write(tmp_path / f"{rows}.csv", "time,Whl [km/h],Yaw,Eng [rpm],Ped,Cool", *map(row, range(rows)))
        table = open_recording(path)
        assert list(table.topics) == ["/table", "/table/Eng_rpm", "/table/Cool"]
        assert [fact.fields for fact in table.facts()] == [("Whl_km_h", "Yaw"), ("Eng_rpm", "Ped"), ("Cool",)]
        assert [fact.rate for fact in table.facts()] == pytest.approx([100, 20, 1] if rows > 60 else [100, 20, None])
    columns = table.columns(["/table/Cool", "/table"], [[FieldPath("Cool")]] * 2)  # of a file that names but /table
    assert columns.values[0][:, 0].tolist() == [20 + k for k in range(30)]
    assert np.flatnonzero(np.isfinite(columns.values[1][:, 0])).tolist() == list(range(7, 3000, 100))


def _by_turns(rows, more=lambda k: ""):
    numbers = [f"{k % 9},," if k % 2 else f",{math.sin(0.1 * k):.5f},{k % 7}" for k in range(rows)]
    return [f"{0.05 * k:.2f},{numbers[k]}{more(k)}" for k in range(rows)]


def test_a_short_log_of_messages_by_turns_has_the_topics_of_a_long_one(tmp_path):
    """A model of a long log refused one of a second: it had the one topic `/table`."""
    for rows in (14, 400):
        path = write(tmp_path / f"{rows}.csv", "time,CMD.u,ATT.r,ATT.p", *_by_turns(rows))
        assert list(open_recording(path).topics) == ["/table/CMD", "/table/ATT"]


@pytest.mark.parametrize("more", [lambda k: k, lambda k: 7, lambda k: int(k > 250)], ids=["index", "constant", "label"])
def test_an_index_or_a_label_of_each_row_does_not_make_messages_by_turns_one(tmp_path, more):
    path = write(tmp_path / "a.csv", "time,CMD.u,ATT.r,ATT.p,more", *_by_turns(400, lambda k: f",{more(k)}"))
    table = open_recording(path)
    assert {topic: info.count for topic, info in table.topics.items()} == {"/table/CMD": 200, "/table/ATT": 200}
    assert [fact.fields for fact in table.facts()] == [("CMD_u", "more"), ("ATT_r", "ATT_p")]
    temperature = _by_turns(400, lambda k: f",{20 + math.sin(0.01 * k):.4f}")
    one = write(tmp_path / "b.csv", "time,CMD.u,ATT.r,ATT.p,T", *temperature)
    assert list(open_recording(one).topics) == ["/table", "/table/CMD_u", "/table/ATT_r"]  # at half its rate
    named = _by_turns(400, lambda k: f",{('ATT', 'CMD')[k % 2]}")
    assert not open_recording(write(tmp_path / "c.csv", "time,CMD.u,ATT.r,ATT.p,type", *named)).warnings  # no units


_RATED = [(192, 24), (216, 64), ("Good", "Bad"), ("good, annotated", "Uncertain (LUV)")]


@pytest.mark.parametrize(("good", "bad"), _RATED)
def test_numbers_that_a_historian_does_not_call_good_are_left_out(tmp_path, good, bad):
    """A sensor that was off had 0 in such rows, which the bounds then had to contain."""
    said = [bad if k in (7, 8, 30) else good for k in range(80)]
    told = {7, 8, 30}
    rows = [f'{k},{0 if k in told else k % 7 + 1},{k % 5},"{q}"' for k, q in enumerate(said)]
    for names in ("time,Level,Flow,Level_Q", "time,Level.Value,Flow,Level.Quality", "time,level,Flow,LEVEL quality"):
        bag = read_csv(tmp_path, names, rows)
        level, flow = list(bag.columns_by_field.values())[:2]
        assert set(np.flatnonzero(np.isnan(level))) == told and np.nanmin(level) == 1 and np.isfinite(flow).all()
        name, quality = names.split(",")[1::2]
        assert f"3 numbers of '{name}' left out, not good by '{quality}'" in bag.warnings[0]
    long = [f'{k},{tag},{0 if k in told and tag == "p" else k % 7 + 1},"{q if tag == "p" else good}"'
            for k, q in enumerate(said) for tag in ("p", "q")]  # fmt: skip
    bag = read_csv(tmp_path, "time,tag,value,quality", long)
    assert {name: np.flatnonzero(np.isnan(c)).tolist() for name, c in bag.columns_by_field.items()} == {
        "p": sorted(told),
        "q": [],
    }
    assert not any("without a name" in text for text in bag.warnings)
    runs = write(tmp_path / "r.csv", "time,Level,Flow,Level_Q,run", *(f"{row},{k // 40}" for k, row in enumerate(rows)))
    several = group_recordings([runs], layout=TableLayout(runs="run"))
    assert [sum("not good by 'Level_Q'" in text for text in run.warnings) for run in several] == [1, 0]
    assert np.isnan(np.concatenate([run.columns_by_field["Level"] for run in several])).sum() == 3


@pytest.mark.parametrize("said", ["Good,Bad", "3,7", "192,191", "0,64", "good,good"])
def test_what_is_no_quality_of_a_number_leaves_it_alone(tmp_path, said):
    """Labels of products, numbers that are no codes of OPC, or none that is good."""
    good, bad = said.split(",")
    quality = "quality" if good == "Good" else "Level_Q"
    rows = [f"{k},{k % 7},{bad if k == 9 else good}" for k in range(80)]
    assert np.isfinite(read_csv(tmp_path, f"time,Level,{quality}", rows).columns_by_field["Level"]).all()
