"""The command line: exit codes, one-line errors, and files that remain after an interrupt."""

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from command_line import refused
from live_server import RIG
from patience import PATIENCE_S, wait_until

from fingerpost.cli import main
from fingerpost.cli.endings import ending_as_interrupted, ending_orderly
from fingerpost.recording import read_points, read_tracks
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 10


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    directory = tmp_path_factory.mktemp("recording")
    return write_recording(directory, SimulatedRig(), Trajectory.hold(pose, 1.0), frames=FRAMES)


def fingerpost(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fingerpost", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=PATIENCE_S,
        check=False,
    )


def test_run_writes_points_and_tracks_and_a_summary(rig_file, tmp_path):
    points, tracks, overlay = (tmp_path / name for name in ("p.csv", "t.csv", "o.mp4"))
    done = fingerpost("run", rig_file, "--points", points, "--tracks", tracks, "--overlay", overlay)
    assert done.returncode == 0, done.stderr
    assert f"frames   {FRAMES}" in done.stdout
    rows = read_points(points)
    assert [row.frame for row in rows] == list(range(FRAMES))
    assert rows[-1].status == "ok"
    assert (rows[-1].x, rows[-1].y) == (pytest.approx(200, abs=3), pytest.approx(200, abs=3))
    assert {row.view for row in read_tracks(tracks)} == {"left", "right"}
    assert len(read_tracks(tracks)) == 2 * FRAMES
    assert overlay.stat().st_size > 0


def test_run_prints_json_lines(rig_file):
    done = fingerpost("run", rig_file, "--json", "--max-frames", 6)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == 6
    assert set(rows[0]) >= {"frame", "time_s", "status", "x", "y", "cov_xx", "crossing_angle_deg"}
    assert rows[0]["status"] == "acquiring"
    assert rows[-1]["status"] == "ok"


def test_run_tracks_with_the_papers_model(rig_file):
    done = fingerpost("run", rig_file, "--json", "--model", "paper")
    assert json.loads(done.stdout.splitlines()[-1])["status"] == "ok"


def test_the_demo_writes_tables_picture_and_video(tmp_path):
    done = fingerpost("demo", "--output", tmp_path / "out", "--max-frames", 12, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["frames"] == 12
    for name in ("points.csv", "tracks.csv", "summary.png", "overlay.webm"):
        assert (tmp_path / "out" / name).stat().st_size > 0


def test_the_experiment_prints_its_table(tmp_path):
    options = ("--targets", 4, "--size", 320, 240, "--seed", 3)
    done = fingerpost("experiment", *options, "--draw", tmp_path / "e.png")
    assert done.returncode == 0, done.stderr
    assert "RMS" in done.stdout
    assert (tmp_path / "e.png").stat().st_size > 0
    assert json.loads(fingerpost("experiment", *options, "--json").stdout)["figures"]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["run", "nowhere.toml"], "nowhere.toml: No such file or directory"),
        (["run"], "Missing argument 'RIG.TOML'"),
        (["run", "rig.toml", "--fast"], "No such option"),
        (["run", "rig.toml", "--max-frames", "0"], "0 is not in the range x>=1"),
        (
            ["experiment", "--noise", "1e-300"],
            "noise is 1e-300; it must be 0 or a number from 1e-06",
        ),
        (["experiment", "--blur", "1e-320"], "blur_px is 1e-320; it must be 0 or a number from"),
        (["experiment", "--size", "99999", "480"], "width_px is 99999"),
        (["experiment", "--guidance", str(10**20)], "is not in the range 0<=x<="),
        (["experiment", "--taper", "3"], "taper is 3.0; it must be a number from 0 to 0.6"),
        (["experiment", "--recording", "rig.toml"], "--recording and --truth go together"),
        (["demo", "--live", "--output", "x"], "--live and --output do not go together"),
        (["demo", "--robot", "--live", "--json"], "--live and --json do not go together"),
        (["demo", "--live", "--seed", "3"], "--live and --seed do not go together"),
        (["demo", "--robot", "--seed", "-1"], "'--seed': -1 is not in the range x>=0"),
        (["demo", "--seed", "3"], "the clip has no --seed; --simulate and --robot have one"),
        (["live", "--arm"], "--arm needs RIG.TOML"),
        (["live", "--speed", "0.1"], "--speed moves nothing by itself"),
        (["live", RIG, "--arm"], "the rig has no [robot] table"),
        (["walk"], "No such command 'walk'"),
        (["robot", "emulate", "puma"], "'puma' is not emulated"),
        (["robot", "emulate", "acl", "--time-scale", "0"], "time_scale is 0.0; from 0.001 to"),
        (["robot", "emulate", "acl", "--homing-s", "x"], "'x' is not a valid float"),
        (["robot", "home", "puma://"], "puma"),
    ],
)
def test_a_mistake_gives_one_line_and_exit_code_2(arguments, line):
    assert line in refused(*arguments)


ODD_NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e300", "1e-300", "1e-320", str(10**20))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ODD_NUMBERS)
@pytest.mark.parametrize(
    "option", ["--length", "--contrast", "--noise", "--blur", "--reference-noise", "--unit-mm"]
)
def test_an_extreme_number_for_the_advisor_is_refused_by_name_or_works(rig_file, option, number):
    check_refused_or_works("advise", rig_file, "--size", 640, 480, option, number)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ["0", "179.9", "180", "-180"])
def test_the_advisor_accepts_a_single_azimuth(rig_file, number):
    done = check_refused_or_works(
        "advise", rig_file, "--size", 640, 480, "--azimuth", number, number
    )
    assert done.exit_code == 0
    assert "expected poses in view" in done.stdout


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ["0", "-1", "100001", str(2**31), str(2**63), "9" * 5000])
def test_an_invalid_size_for_the_advisor_is_refused_by_name(rig_file, number):
    done = check_refused_or_works("advise", rig_file, "--size", 640, number)
    assert done.exit_code == 2


def check_refused_or_works(*arguments: object) -> Result:
    """Invoke a command; it must succeed or fail with one line, and print no NaN or infinity."""
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code in (0, 2), done.output
    if done.exit_code == 2:
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1
        assert " is " in done.stderr or "Invalid value for" in done.stderr
    assert "nan" not in done.stdout
    assert not re.search(r"\binf\b", done.output.replace("is inf;", "").replace("is -inf;", ""))
    return done


@pytest.mark.parametrize("count", [10**20, 2**63])
def test_a_limit_beyond_any_frame_count_is_accepted(rig_file, count):
    done = CliRunner().invoke(main, ["run", str(rig_file), "--max-frames", str(count)])
    assert done.exit_code == 0, done.output
    assert f"frames   {FRAMES}" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["--version"],
        ["run", "--help"],
        ["run", "RIG"],
        ["run", "RIG", "--json"],
        ["advise", "RIG", "--size", "640", "480"],
        ["doctor", "RIG"],
        ["experiment", "--targets", "1", "--size", "320", "240", "--json"],
        ["demo", "--output", "OUT", "--max-frames", "2"],
        ["robot", "list"],
    ],
    ids=" ".join,
)
def test_a_failed_write_to_stdout_gives_one_line(rig_file, tmp_path, arguments, unbuffered):
    named = {"RIG": str(rig_file), "OUT": str(tmp_path)}
    command = [sys.executable, "-m", "fingerpost", *(named.get(a, a) for a in arguments)]
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(
            command,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            timeout=PATIENCE_S,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr == (
        "fingerpost: standard output: cannot be written: No space left on device\n"
    )


@pytest.mark.parametrize(
    ("arguments", "encoding"),
    [
        # ASCII, which lacks most signs, for every table; other encodings for the fastest one.
        (["advise", "RIG", "--size", "640", "480"], "ascii"),
        (["doctor", "RIG"], "ascii"),
        *(
            (["experiment", "--targets", "1", "--size", "320", "240"], encoding)
            for encoding in ("ascii", "latin-1", "cp1252", "cp437", "utf-8")
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_tables_are_printed_in_encodings_that_lack_signs(rig_file, arguments, encoding):
    command = [str(rig_file) if a == "RIG" else a for a in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "fingerpost", *command],
        capture_output=True,
        env=os.environ | {"PYTHONIOENCODING": encoding},
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    assert len(done.stdout.splitlines()) >= 5


def test_a_mistake_in_a_rig_is_reported_with_file_and_key(rig_file, tmp_path):
    text = rig_file.read_text()
    (tmp_path / "rig.toml").write_text(text.replace("angle_deg", "angel_deg", 1))
    line = refused("run", tmp_path / "rig.toml")
    assert str(tmp_path / "rig.toml") in line
    assert "angel_deg" in line


def test_an_output_that_cannot_be_written_is_refused_in_one_line(rig_file, tmp_path):
    assert "no/p.csv" in refused("run", rig_file, "--points", tmp_path / "no" / "p.csv")
    assert "o.gif" in refused("run", rig_file, "--overlay", tmp_path / "o.gif")


def test_a_missing_recording_fails_with_one_line(rig_file, tmp_path):
    (tmp_path / "rig.toml").write_text(rig_file.read_text())
    done = fingerpost("run", tmp_path / "rig.toml")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "left" in done.stderr


@pytest.mark.skipif(not hasattr(signal, "SIGINT") or os.name == "nt", reason="POSIX signals")
def test_ctrl_c_keeps_the_rows_written(tmp_path):
    points = tmp_path / "points.csv"
    demo = subprocess.Popen(
        [sys.executable, "-m", "fingerpost", "demo", "--output", str(tmp_path), "--simulate"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until(lambda: points.exists() and len(points.read_text().splitlines()) >= 5, "a table")
    demo.send_signal(signal.SIGINT)
    _, said = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 130
    assert said.splitlines()[-1] == "fingerpost: stopped"
    assert len(read_points(points)) >= 4


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_terminating_signal_acts_as_ctrl_c(name):
    number = getattr(signal, name)
    with handled(number, signal.SIG_DFL):
        with pytest.raises(KeyboardInterrupt), ending_as_interrupted():
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_DFL


@contextmanager
def handled(number, handler):
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_sigterm_ends_a_background_job_that_ignores_ctrl_c():
    with (
        handled(signal.SIGINT, signal.SIG_IGN),
        pytest.raises(KeyboardInterrupt),
        ending_as_interrupted(),
    ):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("ending", [ending_as_interrupted, ending_orderly])
def test_a_hangup_ignored_under_nohup_has_no_effect(ending):
    with handled(signal.SIGHUP, signal.SIG_IGN), ending():
        signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.skipif(os.name == "nt", reason="POSIX shells")
def test_a_command_runs_with_stderr_closed(rig_file, tmp_path):
    points = tmp_path / "points.csv"
    command = 'exec "$0" -m fingerpost run "$1" --max-frames 3 --points "$2" 2>&-'
    done = subprocess.run(["sh", "-c", command, sys.executable, rig_file, points], check=False)
    assert done.returncode == 0
    assert len(read_points(points)) == 3


def test_the_experiment_accepts_a_lens():
    done = fingerpost("experiment", "--targets", "2", "--k1", "-0.05")
    assert done.returncode == 0, done.stderr
    assert "k1 -0.05" in done.stdout


def test_a_robot_is_homed_from_the_command_line():
    assert "acl" in fingerpost("robot", "list").stdout.split()
    done = fingerpost("robot", "home", "sim://?homing_s=0.1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("x ")
    assert fingerpost("robot", "stop", "sim://").returncode == 0


def test_an_absent_robot_fails_with_one_line():
    done = fingerpost("robot", "home", "acl:///dev/no-such-port")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "/dev/no-such-port" in done.stderr
