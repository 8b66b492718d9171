"""Survey files: what is written is what is read, damage has a place, and a partial file keeps every whole object.

Does not prove: that a disk which lies about fsync keeps anything.
"""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.errors import FormatError, PipefishError
from pipefish.survey import Observations, Survey, lost_indices
from pipefish.surveystore import SurveyStore
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START, SurveyWriter
from synthetic import BOOT, CLOCK, SURVEY, as_object, end, keyframe, start, store_all, survey_objects, write_survey


def test_survey_round_trip_keeps_every_field(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path)
    survey = Survey.open(path)
    assert survey.complete and not survey.damage
    assert [k.index for k in survey.keyframes] == list(range(12))
    _, _, data = keyframe(7)
    sent = pb.Keyframe.FromString(data)
    frame = survey.keyframes[7]
    assert frame.jpeg == sent.jpeg
    assert frame.image.size == (160, 120) and frame.image.mode == "L"
    assert (frame.boot, frame.monotonic_ns) == (BOOT, sent.time.monotonic_ns)
    assert frame.time_ns == sent.time.monotonic_ns + CLOCK[BOOT].offset_ns
    sent.ClearField("jpeg")
    assert frame.message == sent
    assert frame.telemetry == {"encoder_count": 350} and frame.encoder_count == 350
    observations = frame.observations
    assert observations.id.dtype == np.int64 and np.all(np.diff(observations.id) > 0)
    assert observations.xy.shape == (40, 2) and observations.covariance.shape == (40, 2, 2)
    assert observations.xy[0, 0] == sent.observations.x_q16[0] / 65536
    np.testing.assert_allclose(observations.covariance[0], np.array([[10000, -500], [-500, 12000]]) / 2**20)
    assert np.allclose(survey.chainage(), 0.05 * np.arange(12))


def test_survey_is_read_by_the_mcap_library_with_foxglove_schemas(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path, 3)
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        topics = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        messages = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
        assert [m.name for m in reader.iter_metadata()] == ["pipefish"]
    assert topics["/camera"] == "foxglove.CompressedImage"
    assert topics["/camera/tracks"] == "foxglove.ImageAnnotations"
    assert topics["/keyframe"] == "pipefish.v1.Keyframe"
    assert summary.statistics.chunk_count == 5  # one an object
    times = [m.log_time for t, m in messages if t == "/camera"]
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

    marks = [(m.log_time, ImageAnnotations.FromString(m.data)) for t, m in messages if t == "/camera/tracks"]
    assert [t for t, _ in marks] == times
    assert marks[0][1].timestamp.ToNanoseconds() == times[0]
    points = marks[0][1].points[0]
    first = Survey.open(path).keyframes[0].observations.xy[0]
    assert (points.points[0].x, points.points[0].y) == (first[0] + 0.5, first[1] + 0.5)
    assert len(points.outline_colors) == len(points.points) == 40


def test_tracks_are_sorted_and_distinct_over_boots(tmp_path):
    path = tmp_path / "a.mcap"
    second = dict(boot=BOOT + 1, first=3)
    objects = [start(), *(keyframe(i) for i in range(3)), *(keyframe(i, **second) for i in range(3, 6)), end(6)]
    write_survey(path, objects=objects)
    survey = Survey.open(path)
    tracks = survey.tracks()
    order = np.lexsort((tracks.frame, tracks.track))
    assert np.array_equal(order, np.arange(len(order)))
    assert len(tracks.id) == len({(b, i) for b, i in zip(tracks.boot, tracks.id, strict=True)}) == 2 * 60
    assert tracks.length_keyframes.sum() == len(tracks.track) == 240
    assert tracks.length_frames.max() == 10  # two keyframes of five frames
    assert [b["index"] for b in survey.breaks] == [3] and survey.breaks[0]["restart"]
    assert survey.info["boots"] == 2


def test_tracks_can_be_had_where_they_were_found(tmp_path):
    """A tracker that moves places towards what their neighbours say tells by how much; older ones say nothing of it."""
    path, moved = tmp_path / "a.mcap", []
    for index in range(3):
        message = pb.Keyframe.FromString(keyframe(index)[2])
        if index:
            message.observations.settled_x_q8.extend(range(-20, 20))
            message.observations.settled_y_q8.extend([64] * 40)
        moved.append(as_object(OBJECT_KEYFRAME, message))
    write_survey(path, objects=[start(), *moved, end(3)])
    survey = Survey.open(path)
    told, found = survey.tracks(), survey.tracks(as_found=True)
    shift = told.pixels - found.pixels
    for index, frame in enumerate(survey.keyframes):
        here = told.frame == index
        assert np.array_equal(told.id[told.track[here]], frame.observations.id)
        wanted = np.column_stack([np.arange(-20, 20) / 256, np.full(40, 0.25)]) * (index > 0)
        np.testing.assert_array_equal(shift[here], wanted)
    # By what a place was moved its place is uncertain, along that way and no other.
    np.testing.assert_allclose(found.covariance - told.covariance, shift[:, :, None] * shift[:, None, :], atol=1e-12)
    message.observations.settled_x_q8.pop()
    with pytest.raises(ValueError, match="settled"):
        Observations.from_message(message.observations)


def test_chainage_goes_on_over_a_restart_with_the_scale_of_each_boot(tmp_path):
    """The second boot counts from zero, twice as finely; its first keyframe has no count yet."""

    def counted(index: int, count: int | None, **options):
        message = pb.Keyframe.FromString(keyframe(index, **options)[2])
        message.telemetry.Clear()
        if count is not None:
            message.telemetry.encoder_count = count
        return as_object(2, message)

    second = pb.SurveyStart.FromString(start(boot=BOOT + 1)[2])
    second.encoder.metres_per_count = 0.0005
    options = dict(boot=BOOT + 1, first=3)
    objects = [
        *(start(), counted(0, 1000), counted(1, 1200), counted(2, 1500)),
        *(as_object(1, second), counted(3, None, **options), counted(4, 10, **options), counted(5, 210, **options)),
        end(6, boot=BOOT + 1),
    ]
    write_survey(tmp_path / "a.mcap", objects=objects)
    survey = Survey.open(tmp_path / "a.mcap")
    np.testing.assert_allclose(survey.chainage(), [0, 0.2, 0.5, np.nan, 0.5, 0.6])
    assert [(b["index"], b["restart"]) for b in survey.breaks] == [(3, True)]
    assert survey.info["length_m"] == pytest.approx(0.6)


def cut_points(data: bytes) -> list[int]:
    """Every byte of the last object, and a spread of the rest."""
    return sorted({*range(0, len(data), 997), *range(len(data) - 2000, len(data), 13), *range(12)})


def test_a_partial_file_cut_anywhere_keeps_every_whole_object(tmp_path):
    path = tmp_path / "a.mcap"
    objects = survey_objects(4)
    writer_sizes = []
    store = SurveyStore(path)
    for item in objects[:-1]:
        store_all(store, [item])
        writer_sizes.append((tmp_path / "a.mcap.partial").stat().st_size)
    store.close()
    data = (tmp_path / "a.mcap.partial").read_bytes()
    assert writer_sizes[-1] == len(data)
    for cut in cut_points(data):
        for tail in (b"", b"\0" * 700, b"\x05garbage-after-a-power-cut") if cut >= 8 else (b"",):
            (tmp_path / "a.mcap.partial").write_bytes(data[:cut] + tail)
            whole = sum(size <= cut for size in writer_sizes)
            again = SurveyStore(path)
            assert again.recovered in (whole, whole + 1), (cut, tail)  # + 1: cut behind the chunk, in its index
            kept = again.recovered
            assert [again.has(name) for name, _, _ in objects] == [i < kept for i in range(len(objects))]
            again.close()
    (tmp_path / "a.mcap.partial").write_bytes(data[: len(data) - 1])
    again = SurveyStore(path)
    store_all(again, [o for o in objects if not again.has(o[0])])
    again.finish_complete({})
    survey = Survey.open(path)
    assert survey.complete and len(survey.keyframes) == 4 and not (tmp_path / "a.mcap.partial").exists()


def test_recovery_leaves_no_second_file_and_damage_inside_keeps_a_copy(tmp_path):
    path, partial = tmp_path / "a.mcap", tmp_path / "a.mcap.partial"
    store = SurveyStore(path)
    store_all(store, survey_objects(4)[:-1])
    store.close()
    data = bytearray(partial.read_bytes())
    where = data.find(survey_objects(4)[2][2][-200:-150])  # inside keyframe 1's observations
    data[where + 5] ^= 0x40
    partial.write_bytes(data)
    again = SurveyStore(path)
    assert again.recovered == 4
    assert again.writers[SURVEY].content.indices == {0, 2, 3}
    assert again.writers[SURVEY].damaged.read_bytes() == bytes(data)
    again.close()
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap.partial", "a.mcap.partial.damaged"}


def test_a_partial_file_opens_while_it_is_written(tmp_path):
    store = SurveyStore(tmp_path / "a.mcap")
    store_all(store, survey_objects(5)[:4])
    survey = Survey.open(tmp_path / "a.mcap.partial")
    assert [k.index for k in survey.keyframes] == [0, 1, 2]
    assert not survey.complete and survey.keyframes[2].image.size == (160, 120)
    assert survey.info["keyframes"] == 3


def test_damage_in_a_finished_file_names_file_and_offset(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path, 3)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"a\.mcap.*offset \d+"):
        Survey.open(path)
    path.write_bytes(bytes(data[: len(data) // 3]))
    with pytest.raises(FormatError, match=r"offset .*Named a\.mcap\.partial, what is whole"):
        Survey.open(path)
    assert len(Survey.open(path.rename(tmp_path / "a.mcap.partial")).keyframes) < 3, "as the message says"


@pytest.mark.parametrize("content", [b"", b"not a survey at all", b"\x89MCAP0\r\n"])
def test_what_is_no_survey_is_refused_clearly(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"a\.mcap"):
        Survey.open(path)


def test_random_damage_never_crashes_the_reader(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path, 2)
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(300):
        bad = bytearray(data)
        for _ in range(rng.integers(1, 5)):
            bad[rng.integers(len(bad))] = rng.integers(256)
        path.write_bytes(bad[: rng.integers(1, len(bad) + 1)])
        try:
            survey = Survey.open(path)
            for frame in survey.keyframes:
                _ = frame.image
        except FormatError:
            pass


def picture_as(image_format: str, width: int = 160, height: int = 120, claimed: tuple[int, int] = (160, 120)) -> bytes:
    """The bytes of a picture; of a JPEG its header then says `claimed`."""
    out = io.BytesIO()
    Image.new("L", (width, height), 128).save(out, image_format)
    data = bytearray(out.getvalue())
    if image_format == "JPEG":
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", claimed[1], claimed[0])
    return bytes(data)


@pytest.mark.parametrize(
    ("size", "jpeg", "why"),
    [
        ((160, 120), picture_as("JPEG", claimed=(9000, 9000)), "9000 x 9000 pixels, not 160 x 120"),
        ((65000, 65000), picture_as("JPEG", claimed=(65000, 65000)), "decompression bomb"),
        ((0, 0), picture_as("JPEG"), "160 x 120 pixels, not 0 x 0"),
        ((160, 120), picture_as("EPS"), "cannot identify"),  # Pillow has Ghostscript draw it
    ],
    ids=["another size", "bomb", "none", "a program's"],
)
def test_pictures_that_are_made_up_cost_no_memory_and_are_named(tmp_path, size, jpeg, why, capsys):
    message = pb.Keyframe.FromString(keyframe(0)[2])
    message.width, message.height = size
    message.jpeg = jpeg
    write_survey(tmp_path / "a.mcap", objects=[start(), as_object(OBJECT_KEYFRAME, message), end(1)])
    with pytest.raises(FormatError, match=f"picture of keyframe 0: .*{why}"):
        _ = Survey.open(tmp_path / "a.mcap").keyframes[0].image
    assert main(["show", str(tmp_path / "a.mcap"), "-o", str(tmp_path / "a.png")]) == 1
    assert "internal error" not in capsys.readouterr().err


def test_numbers_that_are_none_are_shown_and_stand_in_json_as_null(tmp_path, capsys):
    message = pb.SurveyStart.FromString(start()[2])
    message.frame_rate = float("nan")
    message.encoder.metres_per_count = 1e308
    frames = [keyframe(i) for i in range(7)]
    last = pb.Keyframe.FromString(keyframe(7)[2])
    last.tracking.frames, last.tracking.tracked = 2**64 - 1, 2**64 - 1
    last.tracking.state_frames.append(2**64 - 1)
    frames.append(as_object(OBJECT_KEYFRAME, last))
    write_survey(tmp_path / "a.mcap", objects=[as_object(OBJECT_START, message), *frames, end(8)])
    assert main(["show", str(tmp_path / "a.mcap"), "--stats", "-o", str(tmp_path / "a.html"), "--json"]) == 0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "a.mcap"), "--json"]) == 0
    info = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert info["frame_rate"] is None and info["keyframes"] == 8


def test_the_bytes_must_match_the_name(tmp_path):
    store = SurveyStore(tmp_path / "a.mcap")
    name, kind, data = keyframe(0)
    assert store.store(name, kind, data[:-1] + b"x", CLOCK, 1) is False
    assert not store.has(name) and not store.writers
    assert store.store(name, kind, data, CLOCK, 1) and store.has(name)


def test_an_object_of_another_schema_stays_on_the_device(tmp_path):
    store = SurveyStore(tmp_path / "a.mcap")
    message = pb.Keyframe.FromString(keyframe(0)[2])
    message.observations.age.append(3)
    with pytest.raises(PipefishError, match="stays on the device"):
        store.store(*as_object(2, message), CLOCK, 1)
    with pytest.raises(ValueError, match="values of age"):
        Observations.from_message(message.observations)


def test_leftovers_of_an_earlier_survey_get_their_own_file(tmp_path):
    old = bytes(15) + b"\x07"
    store = SurveyStore(tmp_path / "a.mcap")
    store.choose_primary(SURVEY)
    store_all(store, [keyframe(2, survey=old), *survey_objects(2), end(3, survey=old, lost=(0, 1))])
    done = store.finish_complete({})
    assert done == [tmp_path / "a.mcap"]
    assert store.close() == [tmp_path / "a-2.mcap.partial"]
    assert Survey.open(tmp_path / "a.mcap").survey_id == SURVEY.hex()
    assert Survey.open(tmp_path / "a-2.mcap.partial").survey_id == old.hex()


def test_an_existing_survey_is_not_overwritten_unasked(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path, 2)
    before = path.read_bytes()
    with pytest.raises(PipefishError, match="--overwrite"):
        SurveyStore(path)
    assert path.read_bytes() == before


def test_a_partial_file_of_something_else_is_left_alone(tmp_path):
    partial = tmp_path / "a.mcap.partial"
    partial.write_bytes(b"my thesis")
    with pytest.raises(FormatError):
        SurveyWriter(tmp_path / "a.mcap")
    assert partial.read_bytes() == b"my thesis"
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap.partial"}


def test_an_object_is_on_disk_before_store_returns(tmp_path, monkeypatch):
    import os

    synced = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (synced.append(os.readlink(f"/proc/self/fd/{fd}")), real(fd))[1])
    store = SurveyStore(tmp_path / "a.mcap")
    store_all(store, [start()])
    assert str(tmp_path) in synced, "the folder's entry"
    synced.clear()
    item = keyframe(0)
    store_all(store, [item])
    assert synced == [str(tmp_path / "a.mcap.partial")]
    assert pb.Keyframe.FromString(item[2]).jpeg in (tmp_path / "a.mcap.partial").read_bytes()


def test_lost_keyframes_do_not_keep_a_survey_open(tmp_path):
    path = tmp_path / "a.mcap"
    write_survey(path, objects=[start(), keyframe(0), keyframe(2), end(3, lost=(1,))])
    survey = Survey.open(path)
    assert survey.complete and survey.missing == survey.lost == [1]


def test_a_long_range_of_lost_keyframes_is_understood_and_what_arrived_of_it_is_not_lost(tmp_path):
    path = tmp_path / "survey.mcap"
    message = pb.SurveyEnd.FromString(end(3000)[2])
    message.lost_first.extend((1, 2500))
    message.lost_count.extend((2000, 2**32 - 1))  # joined over keyframe 1500, which did arrive; and past the end
    objects = [start(), keyframe(0), keyframe(1500), *(keyframe(i, tracks=0) for i in range(2001, 2500))]
    write_survey(path, objects=[*objects, as_object(OBJECT_END, message)])
    survey = Survey.open(path)
    assert survey.complete
    assert survey.lost == survey.missing == [*range(1, 1500), *range(1501, 2001), *range(2500, 3000)]


def made_up(what: str) -> tuple[int, pb.Keyframe | pb.SurveyEnd]:
    """A message with a number that no device can have meant: a kind and the message."""
    if what == "count":
        message = pb.SurveyEnd.FromString(end(3)[2])
        message.keyframes = 2**32 - 1
        return OBJECT_END, message
    message = pb.Keyframe.FromString(keyframe(0)[2])
    if what == "index":
        message.index = 2**32 - 1
    else:
        message.time.monotonic_ns = 2**64 - 1
    return OBJECT_KEYFRAME, message


@pytest.mark.parametrize("what", ["count", "index", "time"])
def test_numbers_that_are_made_up_cost_no_memory_and_are_named(tmp_path, what, monkeypatch):
    """4,294,967,295 keyframes as a set of numbers would take all of a computer's memory, from a file of a kilobyte."""
    from pipefish import surveystore, surveywrite

    kind, message = made_up(what)
    store = SurveyStore(tmp_path / "a.mcap")
    with pytest.raises(PipefishError, match="stays on the device"):
        store.store(*as_object(kind, message), CLOCK, 1)
    store.close()
    if what == "time":  # no file can hold it
        return
    for module in (surveystore, surveywrite):
        monkeypatch.setattr(module, "check_numbers", lambda message: None)
    monkeypatch.setattr(surveywrite.Content, "missing", [])
    store = SurveyStore(tmp_path / "b.mcap")
    store_all(store, [start(), as_object(kind, message)])
    store.close()
    monkeypatch.undo()
    for read in (Survey.open, surveywrite.read_content):
        with pytest.raises(FormatError, match="at most 1000000"):
            read(tmp_path / "b.mcap.partial")


def test_ranges_of_lost_keyframes_that_overlap_are_gone_through_once():
    message = pb.SurveyEnd.FromString(end(900_000)[2])
    message.lost_first.extend([5] * 50_000)
    message.lost_count.extend([2**32 - 1] * 50_000)  # one by one: a day
    assert len(lost_indices(message)) == 900_000 - 5


def test_pictures_survive_recompression_by_other_tools(tmp_path):
    """A file that another tool wrote with large compressed chunks reads the same."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "a.mcap"
    write_survey(path, 4)
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start()
    with open(path, "rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        ids = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            ids[channel.id] = writer.register_channel(
                channel.topic, "protobuf", writer.register_schema(schema.name, schema.encoding, schema.data)
            )
        for _, channel, message in reader.iter_messages():
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()
    (tmp_path / "b.mcap").write_bytes(out.getvalue())
    one, two = Survey.open(path), Survey.open(tmp_path / "b.mcap")
    assert [k.jpeg for k in one.keyframes] == [k.jpeg for k in two.keyframes]
    assert [k.time_ns for k in one.keyframes] == [k.time_ns for k in two.keyframes]


def test_a_partial_file_is_locked_until_it_has_its_name(tmp_path):
    path = tmp_path / "a.mcap"
    store = SurveyStore(path)
    store_all(store, survey_objects(2)[:-1])
    for overwrite in (False, True):
        with pytest.raises(PipefishError, match=r"another pipefish receive is writing .*a\.mcap\.partial"):
            SurveyStore(path, overwrite)
    store.close()
    again = SurveyStore(path)  # recovery puts a new file in place: that one is locked too
    with pytest.raises(PipefishError, match="another pipefish receive"):
        SurveyStore(path)
    store_all(again, survey_objects(2)[-1:])
    assert again.finish_complete({}) == [path] and Survey.open(path).complete


@pytest.mark.parametrize("replaced", [False, True])
def test_a_partial_file_that_was_taken_away_is_not_written_on(tmp_path, replaced):
    path, partial = tmp_path / "a.mcap", tmp_path / "a.mcap.partial"
    store = SurveyStore(path)
    store_all(store, survey_objects(2)[:2])
    partial.unlink()
    if replaced:
        partial.write_bytes(b"another")
    with pytest.raises(PipefishError, match="removed or replaced by another program"):
        store_all(store, survey_objects(2)[2:])
    assert store.finish_complete({}) == [] and not path.exists()
    store.close()


def test_overwrite_keeps_the_old_files_until_there_is_something_new(tmp_path):
    path, partial = tmp_path / "a.mcap", tmp_path / "a.mcap.partial"
    other = bytes(15) + b"\x0a"
    write_survey(path, 2)
    partial.write_bytes(b"what an earlier reception left")
    before = path.read_bytes()
    SurveyStore(path, overwrite=True).close()
    assert path.read_bytes() == before and partial.read_bytes() == b"what an earlier reception left"
    store = SurveyStore(path, overwrite=True)
    store_all(store, survey_objects(3, survey=other)[:-1])
    assert path.read_bytes() == before and len(Survey.open(partial).keyframes) == 3
    store_all(store, survey_objects(3, survey=other)[-1:])
    assert store.finish_complete({}) == [path]
    assert Survey.open(path).survey_id == other.hex() and [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_survey_that_appeared_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.mcap"
    store = SurveyStore(path)
    store_all(store, survey_objects(2))
    path.write_bytes(b"of another program")
    with pytest.raises(PipefishError, match="exists already"):
        store.finish_complete({})
    store.close()
    assert path.read_bytes() == b"of another program" and Survey.open(tmp_path / "a.mcap.partial").complete


def test_an_empty_partial_file_of_a_sibling_does_not_receive_the_primary_survey(tmp_path):
    SurveyWriter(tmp_path / "a-2.mcap").close()
    store = SurveyStore(tmp_path / "a.mcap")
    store.choose_primary(SURVEY)
    other = bytes(15) + b"\x0b"
    store_all(store, [*survey_objects(2, survey=other), *survey_objects(2)])
    store.finish_complete({})
    assert Survey.open(tmp_path / "a.mcap").survey_id == SURVEY.hex()
    assert Survey.open(tmp_path / "a-2.mcap").survey_id == other.hex()
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "a-2.mcap"}


def test_a_hole_in_the_numbers_does_not_split_a_survey(tmp_path):
    """a-2.mcap was moved elsewhere; a-3.mcap.partial goes on, and what a-4.mcap holds is not stored again."""
    third, fourth = bytes(15) + b"\x03", bytes(15) + b"\x04"
    for survey_id, number, objects in ((third, 3, 3), (fourth, 4, 4)):
        store = SurveyStore(tmp_path / f"a-{number}.mcap")
        store_all(store, survey_objects(2, survey=survey_id)[:objects])
        store.finish_complete({})
        store.close()
    assert {p.name for p in tmp_path.iterdir()} == {"a-3.mcap.partial", "a-4.mcap"}
    store = SurveyStore(tmp_path / "a.mcap")
    store.choose_primary(SURVEY)
    assert store.has(start(survey=third)[0])
    store_all(store, [*survey_objects(2, survey=third)[3:], *survey_objects(2, survey=fourth)[2:], start()])
    assert store.has(survey_objects(2, survey=fourth)[0][0]), "known after the first object of it"
    store.finish_complete({})
    store.close()
    assert {p.name for p in tmp_path.iterdir()} == {"a-3.mcap", "a-4.mcap", "a.mcap.partial"}
    assert Survey.open(tmp_path / "a-3.mcap").complete
