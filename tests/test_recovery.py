"""Truncated recordings of any program: nothing before the cut is lost."""

import json
import os
import random
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from fingerpost.capture import Frame, open_source
from fingerpost.mcap_file import Message, Records
from fingerpost.recording.session import About, Images, Recorder

FRAMES = 40
CUTS = 40


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "s.mcap"
    noise = np.random.default_rng(0)
    about = About(
        version="1", views=("a",), sources=("a",), started="now", unit="mm", is_live=False
    )
    with Recorder(path, about, "[plane]", [None], images=Images.PNG) as recorder:
        for k in range(FRAMES):
            image = noise.integers(0, 255, (200, 300), dtype=np.uint8)
            list(recorder.watch([(Frame(k, 0.1 * k, image),)]))
    return path


def foreign(path: Path, compression: CompressionType) -> Path:
    """An MCAP file that another program wrote."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression)
        writer.start(profile="other", library="another 2.0")
        schema = writer.register_schema("t.T", "jsonschema", b"{}")
        channel = writer.register_channel("/t", "json", schema, {"key": "value"})
        for k in range(100):
            data = json.dumps({"k": k, "filling": str(np.random.default_rng(k).bytes(60))})
            writer.add_message(channel, k * 10**7, data.encode(), publish_time=k, sequence=k)
        writer.add_attachment(1, 2, "a.txt", "text/plain", b"attached")
        writer.add_metadata("m", {"a": "b"})
        writer.finish()
    return path


def read(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [
            (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]


def ends_of_messages(path: Path) -> list[int]:
    """Offset of the end of each message's chunk; a file cut after it must contain the message."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    counted = []
    for chunk in summary.chunk_indexes:
        with path.open("rb") as file:
            reader = make_reader(file)
            inside = sum(
                1
                for *_, message in reader.iter_messages(
                    starting_at=chunk.message_start_time, ending_at=chunk.message_end_time
                )
            )
        counted.append((chunk.chunk_start_offset + chunk.chunk_length, inside))
    return [end for end, inside in counted for _ in range(inside)]


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_complete_messages_before_a_cut_are_recovered(tmp_path, compression):
    whole = foreign(tmp_path / "whole.mcap", CompressionType[compression.upper()])
    data, messages, ends = whole.read_bytes(), read(whole), ends_of_messages(whole)
    rng = random.Random(compression)
    for k, place in enumerate(sorted(rng.sample(range(60, len(data)), CUTS))):
        cut, recovered = tmp_path / f"cut{k}.mcap", tmp_path / f"r{k}.mcap"
        cut.write_bytes(data[:place])
        done = invoked("recover", cut, recovered)
        assert (done.exit_code, done.stderr) == (0, ""), done.output
        assert f"cut off at byte {place}" in done.stdout
        found = read(recovered)
        assert found == messages[: len(found)]
        assert len(found) >= sum(end <= place for end in ends)


def test_a_whole_file_is_copied_with_attachments_and_metadata(tmp_path):
    whole = foreign(tmp_path / "whole.mcap", CompressionType.ZSTD)
    done = invoked("recover", whole, tmp_path / "copy.mcap")
    assert "it was whole" in done.stdout
    assert read(tmp_path / "copy.mcap") == read(whole)
    with (tmp_path / "copy.mcap").open("rb") as file:
        reader = make_reader(file)
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
        (channel,) = reader.get_summary().channels.values()
        assert reader.get_header().library == "another 2.0"
    assert (attachment.name, attachment.data) == ("a.txt", b"attached")
    assert (metadata.name, metadata.metadata) == ("m", {"a": "b"})
    assert channel.metadata == {"key": "value"}


def test_messages_before_a_cut_within_a_chunk_are_recovered(tmp_path):
    whole = foreign(tmp_path / "whole.mcap", CompressionType.NONE)
    with whole.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[1]
    cut = tmp_path / "cut.mcap"
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    cut.write_bytes(whole.read_bytes()[:middle])
    assert invoked("recover", cut, tmp_path / "r.mcap").exit_code == 0
    count = len(read(tmp_path / "r.mcap"))
    chunks_end = ends_of_messages(whole)
    first, second = sorted(set(chunks_end))[:2]
    assert chunks_end.count(first) < count < chunks_end.count(first) + chunks_end.count(second)


@pytest.mark.parametrize("number", [0, 1], ids=["with the channel", "without it"])
def test_a_damaged_chunk_loses_only_its_own_messages(tmp_path, number):
    whole = foreign(tmp_path / "whole.mcap", CompressionType.ZSTD)
    with whole.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[number]
    data = bytearray(whole.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    done = invoked("recover", tmp_path / "bad.mcap", tmp_path / "r.mcap")
    assert "damaged before byte" in done.stdout
    assert "damaged before byte" in invoked("info", tmp_path / "bad.mcap").stdout
    ends = ends_of_messages(whole)
    lost = ends.count(chunk.chunk_start_offset + chunk.chunk_length)
    assert len(read(tmp_path / "r.mcap")) == len(ends) - lost


def test_reading_from_a_time_passes_over_earlier_chunks(tmp_path):
    data = bytearray(foreign(tmp_path / "whole.mcap", CompressionType.ZSTD).read_bytes())
    (tmp_path / "cut.mcap").write_bytes(data[:-1])
    with (tmp_path / "whole.mcap").open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[1]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF  # would be noticed
    (tmp_path / "indexed.mcap").write_bytes(data)
    for name, wrong in (("indexed", ""), ("cut", f"cut off at byte {len(data) - 1}")):
        records = Records(tmp_path / f"{name}.mcap", start_s=0.5)
        steps = [record.sequence for record in records if isinstance(record, Message)]
        assert (steps, records.wrong) == (list(range(50, 100)), wrong)


def test_a_cut_recording_is_a_source_up_to_the_cut(recording, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    with open_source(f"{cut}#a") as source:
        seen = [frame.index for frame in source]
    assert seen == list(range(len(seen)))
    assert 0 < len(seen) < FRAMES
    assert source.notes == (f"{cut}: cut off at byte {cut.stat().st_size}",)


def test_info_reports_the_same_contents_without_the_index(recording, tmp_path):
    indexed = json.loads(invoked("info", recording, "--json").stdout)
    assert indexed["messages"] == {"/frames": FRAMES, "/a/image": FRAMES, "/a/calibration": 1}
    assert (indexed["wrong"], indexed["dropped"], indexed["about"]["views"]) == ("", 0, ["a"])
    assert indexed["end_ns"] - indexed["start_ns"] == round(0.1 * (FRAMES - 1) * 1e9)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-1])
    counted = json.loads(invoked("info", cut, "--json").stdout)
    differ = {key for key in indexed if indexed[key] != counted[key]}
    assert differ == {"path", "size_bytes", "wrong"}
    assert "cut off" in invoked("info", cut).stdout.splitlines()[0]


def test_files_that_cannot_be_replayed_are_refused_in_one_line(tmp_path):
    other = foreign(tmp_path / "other.mcap", CompressionType.ZSTD)
    assert "another 2.0" in invoked("info", other).stdout
    for name, content, words in (
        ("text.mcap", b"no recording", "is no MCAP file"),
        ("empty.mcap", b"", "is empty"),
        ("start.mcap", other.read_bytes()[:12], "nothing is left"),
        ("other.mcap", other.read_bytes(), "another program (another 2.0)"),
    ):
        (tmp_path / name).write_bytes(content)
        done = invoked("replay", tmp_path / name)
        assert done.exit_code == 2
        (line,) = done.stderr.splitlines()
        assert words in line


def test_a_recovery_onto_a_full_disk_leaves_nothing(recording, tmp_path, monkeypatch):
    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    done = invoked("recover", recording, tmp_path / "r.mcap")
    (line,) = done.stderr.splitlines()
    assert line.endswith(
        "r.mcap: cannot be written any more: No space left on device; nothing is left"
    )
    assert (done.exit_code, list(tmp_path.iterdir())) == (1, [])


def test_recovery_overwrites_no_file(recording, tmp_path):
    (tmp_path / "there.mcap").write_bytes(b"precious")
    done = invoked("recover", recording, tmp_path / "there.mcap")
    assert done.exit_code == 2
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"
    assert "would overwrite" in invoked("recover", recording, recording).stderr
