"""Map updates as bytes: nothing is lost, and whatever comes in, only an InputError comes out."""

from __future__ import annotations

import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_samples import CLASSES, SIZE_M, K, assert_same, observe

from surfclass import map_pb2
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.voxel_map import VoxelMap
from surfclass.wire import (
    PART_BYTES,
    Assembler,
    decode_update,
    encode_parts,
    encode_update,
    join,
    split,
    voxels_per_part,
)

ROOT = Path(__file__).resolve().parents[1]
few = settings(deadline=None, max_examples=40)


def sample(points: int = 40, seed: int = 0, extent_m: float = 0.1) -> MapUpdate:
    return VoxelMap(SIZE_M, CLASSES, epoch="0123456789abcdef" * 2).add(observe(points, seed, extent_m), 77)


@few
@given(st.integers(0, 60), st.integers(0, 1000))
def test_an_update_comes_back_bit_for_bit(points: int, seed: int) -> None:
    update = sample(points, seed)
    data = encode_update(update)
    assert_same(decode_update(data, K), update)
    assert encode_update(decode_update(data, K)) == data


@few
@given(st.integers(0, 60), st.integers(1, 70), st.randoms(use_true_random=False))
def test_parts_in_any_order_and_repetition_make_the_whole(points: int, size: int, order) -> None:
    update = sample(points)
    pieces = split(update, size)
    assert max(len(piece.index) for piece in pieces) <= size
    assert {(piece.epoch, piece.sequence, piece.t_ns) for piece in pieces} == {
        (update.epoch, update.sequence, update.t_ns)
    }
    assert_same(join(pieces), update)
    messages = [encode_update(piece, part, len(pieces)) for part, piece in enumerate(pieces)]
    again = order.sample(messages, len(messages))
    assembler = Assembler(K)
    for message in again[:-1]:
        assert assembler.take(message) is None
        if len(messages) > 1:
            assert assembler.take(message) is None
    whole = assembler.take(again[-1])
    assert whole is not None
    assert_same(whole, update)


def test_a_piece_by_itself_is_an_update_that_a_map_can_take() -> None:
    update = sample()
    mirror = VoxelMap(SIZE_M, CLASSES)
    for piece in split(update, 7):
        assert mirror.apply(piece)
    original = VoxelMap(SIZE_M, CLASSES)
    original.apply(update)
    assert_same(mirror.snapshot(), original.snapshot())


def test_an_incomplete_update_is_dropped_when_the_next_one_begins() -> None:
    first, second = sample(), replace(sample(seed=1), sequence=2)
    lost = encode_update(split(first, 7)[0], 0, 2)
    assembler = Assembler(K)
    assert assembler.take(lost) is None
    whole = assembler.take(encode_update(second))
    assert whole is not None
    assert whole.sequence == 2
    assert assembler.take(encode_update(split(first, 7)[1], 1, 2)) is None


def test_parts_fit_the_transports_batches() -> None:
    update = sample(20_000, extent_m=0.5)
    messages = encode_parts(update)
    assert len(messages) == -(-len(update.index) // voxels_per_part(K)) > 10
    assert max(map(len, messages)) <= PART_BYTES + 200
    # Bytes columns: the message is the arrays and little else.
    assert sum(map(len, messages)) < len(update.index) * (24 + 8 * K) + 200 * len(messages)


def test_a_part_is_not_taken_for_the_whole() -> None:
    message = encode_update(split(sample(), 7)[0], 0, 2)
    with pytest.raises(InputError, match="part 0 of 2"):
        decode_update(message, K)


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=400))
def test_garbage_is_an_input_error(data: bytes) -> None:
    for decode in (lambda: decode_update(data, K), lambda: Assembler(K).take(data)):
        with pytest.raises(InputError, match="map update"):
            decode()


def test_damaged_messages_are_input_errors_or_harmless() -> None:
    """Every cut and a thousand flipped bits: what is still taken for an update is one a map can take."""
    whole = encode_update(sample(6))
    for end in range(len(whole)):
        with pytest.raises(InputError):
            decode_update(whole[:end], K)
    bits = random.Random(0)
    refused = 0
    for _ in range(1000):
        damaged = bytearray(whole)
        damaged[bits.randrange(len(whole))] ^= 1 << bits.randrange(8)
        mirror = VoxelMap(SIZE_M, CLASSES)
        try:
            mirror.apply(decode_update(bytes(damaged), K))
        except InputError:
            refused += 1
        else:
            assert np.isfinite(mirror.fused().p).all()
    assert refused > 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"classes": 4}, "of 4 classes, needs 5"),
        ({"epoch": "x"}, "epoch"),
        ({"parts": 0}, "part 0 of 0"),
        ({"index": b"123"}, "index has 3 bytes"),
        ({"weight": b""}, "weight has 0 bytes, which are not"),
        ({"voxels": 0}, "which are not 0 voxels"),
        ({"sequence": 2**64 - 1}, "sequence"),
        ({"t_ns": -1}, "t_ns"),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, object], message: str) -> None:
    wrong = map_pb2.MapUpdate.FromString(encode_update(sample(6)))
    for name, value in change.items():
        setattr(wrong, name, value)
    with pytest.raises(InputError, match=message):
        decode_update(wrong.SerializeToString(), K)


def test_the_generated_code_is_that_of_the_proto_file(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools", reason="grpcio-tools generates the code that this compares with")
    (tmp_path / "surfclass").mkdir()
    arguments = ["-I.", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", "surfclass/map.proto"]
    subprocess.run([sys.executable, "-m", "grpc_tools.protoc", *arguments], cwd=ROOT, check=True)
    for name in ("map_pb2.py", "map_pb2.pyi"):
        assert (tmp_path / "surfclass" / name).read_text() == (ROOT / "surfclass" / name).read_text(), name
