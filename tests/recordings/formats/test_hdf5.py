import numpy as np
import pytest

from polarnet.recordings.formats.hdf5 import trigger_times_us
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from polarnet.storage.exchange import write_hdf5

h5py = pytest.importorskip("h5py")


def write_dsec(path, offset=None, **columns):
    names = {"t": [3, 9], "x": [639, 0], "y": [479, 0], "p": [1, 0]} | columns
    with h5py.File(path, "w") as file:
        for name, values in names.items():
            if values is not None:
                file[f"events/{name}"] = np.asarray(values)
        if offset is not None:
            file["t_offset"] = offset
    return path


def write_e2p(path, events, resolution=(346, 260)):
    with h5py.File(path, "w") as file:
        file["events"] = np.asarray(events, np.uint32)
        if resolution:
            file.attrs["sensor_resolution"] = resolution
    return path


def test_dsec_that_polarnet_exports_reads_back_equal(tmp_path, make_random_events, same_events):
    events = make_random_events(0, 3000, 10**6, 12, 18)
    write_hdf5(tmp_path / "e.h5", events, 10**6)
    recording = read_recording(tmp_path / "e.h5")
    assert recording.format == "dsec"
    assert same_events(recording.events, events)


def test_dsecs_own_files_begin_at_their_offset_and_need_the_size_of_the_sensor(tmp_path):
    path = write_dsec(tmp_path / "e.h5", np.int64(49_599_300_523))
    with pytest.raises(RecordingError, match=r"e\.h5: the file does not say how large the sensor is"):
        read_recording(path)
    events = read_recording(path, height=480, width=640).events
    assert events.t.tolist() == [49_599_300_526, 49_599_300_532]
    assert events.p.tolist() == [1, -1]


def test_dsecs_own_compression_is_read(tmp_path):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", data=np.arange(2), chunks=(2,), **hdf5plugin.Blosc())
    assert read_recording(tmp_path / "e.h5", height=4, width=4).events.t.tolist() == [0, 1]


def test_e2p_is_a_table_of_t_x_y_p_with_width_before_height(tmp_path):
    recording = read_recording(write_e2p(tmp_path / "e.h5", [[5, 345, 1, 1], [9, 0, 259, 0]]))
    events = recording.events
    assert (recording.format, events.height, events.width) == ("e2p", 260, 346)
    assert [events.t.tolist(), events.x.tolist(), events.y.tolist()] == [[5, 9], [345, 0], [1, 259]]
    assert events.p.tolist() == [1, -1]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": None}, "there is no events/x"),
        ({"x": [1, 2, 3]}, "different lengths"),
        ({"y": [[1, 2]]}, "expected events/y as a table of another shape"),
        ({"p": np.array([b"a", b"b"])}, "expected numbers in events/p"),
        ({"t": [0.5, 1.0]}, "expected whole microseconds"),
        ({"x": [0.5, 1.0]}, "x and y to be whole numbers"),
        ({"offset": "noon"}, "expected a whole number as t_offset"),
        ({"offset": np.uint64(2**63)}, "expected a whole number as t_offset"),
    ],
)
def test_other_columns_are_refused_by_name(tmp_path, columns, message):
    with pytest.raises(RecordingError, match=rf"e\.h5: .*{message}"):
        read_recording(write_dsec(tmp_path / "e.h5", **columns), height=480, width=640)


def test_e2p_of_another_shape_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"expected events as a table of another shape, got \(1, 3\)"):
        read_recording(write_e2p(tmp_path / "a.h5", [[1, 2, 3]]))
    with pytest.raises(RecordingError, match="expected width and height as sensor_resolution"):
        read_recording(write_e2p(tmp_path / "b.h5", [[1, 2, 3, 1]], (1, 2, 3)))
    with pytest.raises(RecordingError, match="in the layout of E2P, there is no events"):
        read_recording(write_dsec(tmp_path / "c.h5"), "e2p")


def test_a_damaged_file_is_refused_with_what_hdf5_says(tmp_path):
    path = write_dsec(tmp_path / "e.h5")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(RecordingError, match=r"e\.h5: HDF5 cannot read it: .*truncated"):
        read_recording(path, height=480, width=640)


def write_esfp(path, triggers=None, **columns):
    names = {"t": [3.0, 9.0], "x": [5, 0], "y": [1, 0], "p": [True, False]} | columns
    with h5py.File(path, "w") as file:
        for name, values in names.items():
            file[name] = np.asarray(values)
        if triggers is not None:
            file["triggers"] = np.asarray(triggers)
    return path


def test_esfp_has_its_columns_at_the_top_of_the_file(tmp_path):
    recording = read_recording(write_esfp(tmp_path / "e.h5"), height=2, width=6)
    events = recording.events
    assert recording.format == "esfp"
    assert (events.t.tolist(), events.x.tolist(), events.p.tolist()) == ([3, 9], [5, 0], [1, -1])
    with pytest.raises(RecordingError, match="columns t, x, y, p have different lengths"):
        read_recording(write_esfp(tmp_path / "e.h5", x=[1]), height=2, width=6)


def test_triggers_are_read_where_present(tmp_path):
    assert trigger_times_us(write_esfp(tmp_path / "e.h5", [10, 20, 30])).tolist() == [10, 20, 30]
    with pytest.raises(RecordingError, match="expected a table /triggers"):
        trigger_times_us(write_esfp(tmp_path / "f.h5"))


PROPHESEE = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])


def write_metavision(path, rows, geometry="640x480", dtype=PROPHESEE, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("CD/events", data=np.array(rows, dtype), **options)
        if geometry:
            file.attrs["geometry"] = geometry
    return path


def test_prophesees_table_has_records_of_x_y_p_t_and_its_geometry(tmp_path):
    path = write_metavision(tmp_path / "e.hdf5", [(639, 0, 1, 5), (0, 479, 0, 9)], chunks=(2,), compression="gzip")
    recording = read_recording(path)
    events = recording.events
    assert (recording.format, events.height, events.width) == ("metavision", 480, 640)
    assert [events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist()] == [
        [5, 9],
        [639, 0],
        [0, 479],
        [1, -1],
    ]
    with pytest.raises(RecordingError, match="the file does not say how large the sensor is"):
        read_recording(write_metavision(tmp_path / "f.hdf5", [(1, 2, 1, 5)], None))
    other = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2")])
    with pytest.raises(RecordingError, match="expected records of x, y, p, t in CD/events, there is no t"):
        read_recording(write_metavision(tmp_path / "g.hdf5", [(1, 2, 1)], dtype=other))
    with pytest.raises(RecordingError, match="expected HDF5 in the layout of Prophesee, there is no CD/events"):
        read_recording(write_dsec(tmp_path / "h.h5"), "metavision")


def test_prophesees_own_compression_names_the_plugin_that_it_needs(tmp_path):
    ecf, optional = 0x8ECF, 1  # optional, so that HDF5 writes a file for it without having the filter
    with h5py.File(tmp_path / "e.hdf5", "w") as file:
        file.attrs["geometry"] = "640x480"
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((2,))
        settings.set_filter(ecf, optional)
        kind, space = h5py.h5t.py_create(PROPHESEE), h5py.h5s.create_simple((2,))
        table = h5py.h5d.create(file.create_group("CD").id, b"events", kind, space, settings)
        table.write_direct_chunk((0,), bytes(8), filter_mask=0)
    with pytest.raises(RecordingError, match=r"for Prophesee's ECF install the HDF5 plugin.*HDF5_PLUGIN_PATH"):
        read_recording(tmp_path / "e.hdf5")
