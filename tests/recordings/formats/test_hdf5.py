import numpy as np
import pytest

from polarnet.recordings.formats.hdf5 import trigger_times_us
from polarnet.recordings.source import RecordingError

h5py = pytest.importorskip("h5py")

PROPHESEE = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])


def write(path, tables, **attributes):
    with h5py.File(path, "w") as file:
        for name, values in tables.items():
            if values is not None:
                file[name] = values
        file.attrs.update(attributes)
    return path


def write_dsec(path, offset=None, **columns):
    columns = {"t": [3, 9], "x": [639, 0], "y": [479, 0], "p": [1, 0]} | columns
    return write(path, {f"events/{name}": values for name, values in columns.items()} | {"t_offset": offset})


def write_e2p(path, events, resolution=(346, 260)):
    return write(path, {"events": np.array(events, np.uint32)}, sensor_resolution=resolution)


def write_esfp(path, triggers=None, **columns):
    columns = {"t": [3.0, 9.0], "x": [5, 0], "y": [1, 0], "p": [True, False]} | columns
    return write(path, columns | {"triggers": triggers})


def test_dsecs_own_files_begin_at_their_offset_and_may_be_compressed(tmp_path, read):
    path = write_dsec(tmp_path / "e.h5", np.int64(49_599_300_523))
    with pytest.raises(RecordingError, match=r"e\.h5: the file does not say how large the sensor is"):
        read(path)
    _, columns, _ = read(path, height=480, width=640)
    assert columns == [[49_599_300_526, 49_599_300_532], [639, 0], [479, 0], [1, -1]]
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", data=np.arange(2), chunks=(2,), **hdf5plugin.Blosc())
    assert read(tmp_path / "e.h5", height=4, width=4)[1][0] == [0, 1]


def test_e2p_is_a_table_of_t_x_y_p_with_width_before_height(tmp_path, read):
    form, columns, _ = read(write_e2p(tmp_path / "e.h5", [[5, 345, 1, 1], [9, 0, 259, 0]]))
    assert (form, columns) == (("e2p", 260, 346), [[5, 9], [345, 0], [1, 259], [1, -1]])
    with pytest.raises(RecordingError, match=r"expected events as a table of another shape, got \(1, 3\)"):
        read(write_e2p(tmp_path / "a.h5", [[1, 2, 3]]))
    with pytest.raises(RecordingError, match="expected width and height as sensor_resolution"):
        read(write_e2p(tmp_path / "b.h5", [[1, 2, 3, 1]], (1, 2, 3)))
    with pytest.raises(RecordingError, match=r"expected HDF5 of E2P, .*: there is no events"):
        read(write_dsec(tmp_path / "c.h5"), "e2p")


def test_esfp_has_its_columns_at_the_top_of_the_file_and_triggers(tmp_path, read):
    form, columns, _ = read(write_esfp(tmp_path / "e.h5", [10, 20, 30]), height=2, width=6)
    assert (form, columns) == (("esfp", 2, 6), [[3, 9], [5, 0], [1, 0], [1, -1]])
    assert trigger_times_us(tmp_path / "e.h5").tolist() == [10, 20, 30]
    with pytest.raises(RecordingError, match="expected a table /triggers"):
        trigger_times_us(write_esfp(tmp_path / "f.h5"))
    with pytest.raises(RecordingError, match="columns t, x, y, p have different lengths"):
        read(write_esfp(tmp_path / "e.h5", x=[1]), height=2, width=6)


def test_prophesees_table_has_records_of_x_y_p_t_and_its_geometry(tmp_path, read):
    rows = np.array([(639, 0, 1, 5), (0, 479, 0, 9)], PROPHESEE)
    form, columns, _ = read(write(tmp_path / "e.hdf5", {"CD/events": rows}, geometry="640x480"))
    assert (form, columns) == (("metavision", 480, 640), [[5, 9], [639, 0], [0, 479], [1, -1]])
    with pytest.raises(RecordingError, match="the file does not say how large the sensor is"):
        read(write(tmp_path / "f.hdf5", {"CD/events": rows}))
    with pytest.raises(RecordingError, match="expected records of x, y, p, t in CD/events, there is no t"):
        read(write(tmp_path / "g.hdf5", {"CD/events": rows[["x", "y", "p"]]}))
    with pytest.raises(RecordingError, match="expected HDF5 of Prophesee: there is no CD/events"):
        read(write_dsec(tmp_path / "h.h5"), "metavision")


@pytest.mark.parametrize("geometry", [b"640x480", np.bytes_("640x480"), np.array(["640x480"], "S7")])
def test_a_geometry_of_fixed_length_is_read(tmp_path, read, geometry):
    rows = np.array([(639, 0, 1, 5)], PROPHESEE)
    assert read(write(tmp_path / "e.hdf5", {"CD/events": rows}, geometry=geometry))[0] == ("metavision", 480, 640)


@pytest.mark.parametrize(("ts", "t"), [([0.0, 0.001164], [0, 1164]), ([5.0, 9.0], [5, 9]), ([5, 9], [5, 9])])
@pytest.mark.parametrize("size", [(480, 640), (640, 480)])
def test_monash_has_seconds_or_microseconds_and_its_size_in_either_order(tmp_path, read, ts, t, size):
    columns = {"xs": [639, 0], "ys": [0, 479], "ts": ts, "ps": [True, False]}
    path = write(tmp_path / "e.h5", {f"events/{name}": v for name, v in columns.items()}, sensor_resolution=size)
    assert read(path) == (("monash", 480, 640), [t, [639, 0], [0, 479], [1, -1]], {})


def test_a_file_of_two_cameras_needs_the_camera(tmp_path, read):
    columns = {"x": [1279, 0], "y": [0, 719], "t": [5, 9], "p": [1, 0]}
    left = {f"prophesee/left/{name}": values for name, values in columns.items()}
    left["prophesee/left/calib/resolution"] = [1280, 720]
    path = write(tmp_path / "one.h5", left)
    assert read(path) == (("m3ed", 720, 1280), [[5, 9], [1279, 0], [0, 719], [1, -1]], {})
    table = np.array([[345, 0, 1.5, 1], [0, 259, 1.500004, -1]])
    path = write(tmp_path / "two.h5", {"davis/left/events": table, "davis/right/events": table[:1]})
    with pytest.raises(RecordingError, match=r"two\.h5: say which camera to read, --part with one of left, right"):
        read(path, height=260, width=346)
    form, columns, _ = read(path, height=260, width=346, part="left")
    assert (form, columns) == (("mvsec", 260, 346), [[1_500_000, 1_500_004], [345, 0], [0, 259], [1, -1]])


def test_prophesees_own_compression_names_the_plugin_that_it_needs(tmp_path, read):
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
        read(tmp_path / "e.hdf5")


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
def test_other_columns_are_refused_by_name(tmp_path, read, columns, message):
    with pytest.raises(RecordingError, match=rf"e\.h5: .*{message}"):
        read(write_dsec(tmp_path / "e.h5", **columns), height=480, width=640)


def test_a_damaged_file_is_refused_with_what_hdf5_says(tmp_path, read):
    path = write_dsec(tmp_path / "e.h5")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(RecordingError, match=r"e\.h5: HDF5 cannot read it: .*truncated"):
        read(path, height=480, width=640)
