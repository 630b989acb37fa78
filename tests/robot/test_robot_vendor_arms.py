"""Import of vendors' libraries: missing, broken or noisy ones."""

import sys

import pytest

from fingerpost.errors import MissingExtraError
from fingerpost.installation import require
from fingerpost.robot.extras import require_silently
from fingerpost.robot.feetech import ServoBus
from fingerpost.robot.rosbridge import RosbridgeArm
from fingerpost.robot.serial_line import SerialLine
from fingerpost.robot.ur import UniversalRobot
from fingerpost.robot.xarm import Xarm


@pytest.mark.parametrize(
    ("module", "make", "extra"),
    [
        ("rtde_control", UniversalRobot, "ur"),
        ("xarm.wrapper", Xarm, "xarm"),
        ("websockets.client", RosbridgeArm, "ros"),
        (
            "scservo_sdk",
            lambda address: ServoBus(SerialLine(address), {}, float, reply_s=1),
            "so101",
        ),
    ],
)
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    monkeypatch, module, make, extra
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'fingerpost\[{extra}\]'"):
        make("10.0.0.5")


@pytest.mark.parametrize("importing", [require, require_silently])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import no_such_module_at_all", "No module named 'no_such_module_at_all'"),
        ("raise OSError(13, 'Permission denied', '/home/x')", "PermissionError"),
        ("1 / 0", "ZeroDivisionError"),
        ("raise ImportError('libboost.so.1: cannot open')", "libboost.so.1"),
    ],
)
def test_an_import_error_of_a_library_is_quoted(tmp_path, monkeypatch, importing, text, words):
    (tmp_path / "a_broken_library.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtraError, match=r"cannot be imported.*--force-reinstall") as caught:
        importing("a_broken_library", "ur")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_output_of_a_library_is_redirected_from_its_import_on(tmp_path, monkeypatch, capfd, caplog):
    (tmp_path / "a_loud_library.py").write_text(
        "import logging, sys\n"
        "print('hello')\n"
        "log = logging.Logger('loud')\n"
        "log.addHandler(logging.StreamHandler(sys.stdout))\n"
        "def speak(**fields):\n"
        "    print('one', 'two', sep='-', **fields)\n"
        "    log.error('three')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    caplog.set_level("INFO")
    library = require_silently("a_loud_library", "xarm")
    library.speak()
    library.speak(file=None, flush=True)
    library.speak(file=sys.stderr)
    library.speak(file=sys.stdout)
    out, err = capfd.readouterr()
    assert out == ""
    assert err == "one-two\n"
    assert [record.message for record in caplog.records] == (
        ["hello", *["one-two", "three"] * 2, "three", "one-two", "three"]
    )
