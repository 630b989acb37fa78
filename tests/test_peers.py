"""`benches/peers`: a peer that is not available is skipped, and its installation named."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fingerpost.capture import open_views
from fingerpost.config import Rig

PEERS = Path(__file__).resolve().parents[1] / "benches" / "peers"
CLIP = PEERS.parents[1] / "python" / "fingerpost" / "data" / "desk"
INSTALL = "apt install no-such-library-dev"


@pytest.fixture
def peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("peers", PEERS / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "peers", module)  # dataclasses look it up there
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "BUILD", tmp_path)
    return module


def row_of_native(peers: ModuleType, source: Path) -> str:
    native = peers.Native(str(source), (), INSTALL)
    peer = peers.Peer("a peer in C++", "visp.py", native=native)
    return str(peers.row_of(peer, CLIP / "rig.toml", CLIP / "truth.csv"))


def test_a_peer_without_its_library_is_skipped_with_the_command(
    peers: ModuleType, tmp_path: Path
) -> None:
    source = tmp_path / "peer.cpp"
    source.write_text("#include <no/such/library.h>\nint main() {}\n", encoding="utf-8")
    row = row_of_native(peers, source)
    assert row.startswith("| a peer in C++ | skipped: ")
    assert f"`{INSTALL}`" in row
    assert row.count("|") == 10  # as many columns as the table


def test_a_peer_without_a_compiler_is_skipped_with_the_command(
    peers: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    row = row_of_native(peers, tmp_path / "peer.cpp")
    assert "skipped: no compiler" in row
    assert f"`{INSTALL}`" in row


def test_footage_and_truth_travel_with_the_benchmark(peers: ModuleType) -> None:
    assert len(peers.FOOTAGE) == 2
    for folder in peers.FOOTAGE:
        rig = Rig.load(folder / "rig.toml")
        header, *rows = (folder / "truth.csv").read_text(encoding="utf-8").splitlines()
        assert header == "frame,time_s,x,y"
        assert len(rows) >= 90
        with open_views(rig.sources) as sources:
            assert all(source.frame_count > int(rows[-1].split(",")[0]) for source in sources)
        lines = list(peers.table_of(folder / "rig.toml", folder / "truth.csv", ()))
        assert lines[0].strip() == folder.name
        assert lines[-1].count("|") == 10
    assert "MIT License" in (PEERS / "mat" / "LICENSE.txt").read_text(encoding="utf-8")


def test_native_peers_name_their_package_and_have_a_source(peers: ModuleType) -> None:
    natives = [peer.native for peer in peers.PEERS if peer.native is not None]
    assert natives
    assert all(native.install.startswith("apt install ") for native in natives)
    assert all((PEERS / native.source).is_file() for native in natives)
