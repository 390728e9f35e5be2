"""The map file: exactly the arrays that others rely on, the same bytes for the same map, no pickle."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_samples import CLASSES, SIZE_M, K, observe

from surfclass.errors import InputError
from surfclass.map_file import from_npz_bytes, to_npz_bytes
from surfclass.voxel_map import VoxelMap


def sample() -> VoxelMap:
    voxels = VoxelMap(SIZE_M, CLASSES)
    voxels.add(observe(300, 1), 10)
    return voxels


def test_the_file_has_the_arrays_that_are_promised_and_no_others() -> None:
    voxels = sample()
    n = len(voxels)
    with np.load(io.BytesIO(to_npz_bytes(voxels)), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    assert {name: (array.dtype.kind, array.shape) for name, array in arrays.items()} == {
        "voxel_size_m": ("f", ()),
        "classes": ("U", (K,)),
        "colours": ("U", (K,)),
        "index": ("i", (n, 3)),
        "p_colour": ("f", (n, K)),
        "p_texture": ("f", (n, K)),
        "p": ("f", (n, K)),
        "weight": ("f", (n,)),
        "count": ("i", (n,)),
        "made_with": ("U", (0, 2)),
    }
    assert arrays["index"].dtype == np.int32
    assert arrays["p"].dtype == arrays["p_colour"].dtype == arrays["p_texture"].dtype == np.float32
    assert float(arrays["voxel_size_m"]) == SIZE_M
    assert arrays["classes"].tolist() == list(CLASSES.names)
    np.testing.assert_array_equal(arrays["p"], voxels.fused().p)


def test_a_map_without_colours_is_read_too_and_wrong_ones_are_refused() -> None:
    with np.load(io.BytesIO(to_npz_bytes(sample())), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    assert from_npz_bytes(to_npz_bytes(sample()), "map").colours == CLASSES.colours
    without, wrong = io.BytesIO(), io.BytesIO()
    np.savez(without, **{name: array for name, array in arrays.items() if name != "colours"})
    assert from_npz_bytes(without.getvalue(), "map").colours is None
    np.savez(wrong, **{**arrays, "colours": arrays["colours"][:-1]})
    with pytest.raises(InputError, match="colours"):
        from_npz_bytes(wrong.getvalue(), "map")


def test_a_map_says_what_it_was_made_with_and_one_that_does_not_is_read_too() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES, made_with={"light": "ab12", "cameras": "cd34"})
    assert from_npz_bytes(to_npz_bytes(voxels), "map").made_with == {"cameras": "cd34", "light": "ab12"}
    with np.load(io.BytesIO(to_npz_bytes(voxels)), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    without, wrong = io.BytesIO(), io.BytesIO()
    np.savez(without, **{name: array for name, array in arrays.items() if name != "made_with"})
    assert from_npz_bytes(without.getvalue(), "map").made_with == {}
    np.savez(wrong, **{**arrays, "made_with": arrays["made_with"][:, :1]})
    with pytest.raises(InputError, match="made_with"):
        from_npz_bytes(wrong.getvalue(), "map")


def test_the_same_map_gives_the_same_bytes_whatever_its_history() -> None:
    """Another epoch, another order of the voxels inside, another moment: not one byte differs."""
    first = sample()
    delta = first.snapshot()
    second = VoxelMap(SIZE_M, CLASSES)
    half = len(first) // 2
    columns = ("index", "colour", "texture", "weight", "colour_count", "texture_count")
    for rows in (slice(half, None), slice(0, half)):
        second.apply(type(delta)("a" * 32, 1, 0, *[getattr(delta, name)[rows] for name in columns]))
    assert to_npz_bytes(second) == to_npz_bytes(first)
    assert to_npz_bytes(first, "linear") != to_npz_bytes(first)
    entries = zipfile.ZipFile(io.BytesIO(to_npz_bytes(first))).infolist()
    assert {(entry.date_time, entry.create_system) for entry in entries} == {((1980, 1, 1, 0, 0, 0), 3)}


def test_a_file_read_back_is_the_map() -> None:
    voxels = sample()
    for source in (voxels, VoxelMap(SIZE_M, CLASSES)):
        read = from_npz_bytes(to_npz_bytes(source, "linear"), "map.npz")
        layers = source.fused("linear")
        assert (read.voxel_size_m, read.classes) == (SIZE_M, CLASSES.names)
        for name in ("index", "p_colour", "p_texture", "p", "weight", "count"):
            np.testing.assert_array_equal(getattr(read.layers, name), getattr(layers, name))


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_a_damaged_file_is_an_input_error(data) -> None:
    whole = bytearray(to_npz_bytes(sample()))
    damage = data.draw(st.sampled_from(["cut", "flip", "noise"]))
    if damage == "cut":
        whole = whole[: data.draw(st.integers(0, len(whole) - 1))]
    elif damage == "noise":
        whole = bytearray(data.draw(st.binary(max_size=300)))
    else:
        # Headers and directory, where damage is not plainly caught by the checksums.
        at = data.draw(st.one_of(st.integers(0, 300), st.integers(len(whole) - 700, len(whole) - 1)))
        whole[at] ^= 1 << data.draw(st.integers(0, 7))
    read, refusal = None, ""
    try:
        read = from_npz_bytes(bytes(whole), "map.npz")
    except InputError as error:
        refusal = str(error)
    if read is None:
        assert refusal.startswith("map.npz: ")
    else:  # some bits mean nothing
        assert damage == "flip"
        np.testing.assert_array_equal(read.layers.p, sample().fused().p)


def test_what_is_missing_is_named() -> None:
    file = io.BytesIO()
    np.savez(file, index=np.zeros((0, 3), np.int32), classes=np.array(["a"]))
    with pytest.raises(InputError, match="lacks voxel_size_m, p_colour, p_texture, p, weight, count"):
        from_npz_bytes(file.getvalue(), "map.npz")


def test_pickles_are_not_opened() -> None:
    file = io.BytesIO()
    np.savez(file, index=np.array([{"a": 1}], object), **dict.fromkeys(("p", "weight"), np.zeros(1)))
    with pytest.raises(InputError, match="not a map file"):
        from_npz_bytes(file.getvalue(), "map.npz")
