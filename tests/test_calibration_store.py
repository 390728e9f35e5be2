"""Results of commissioning: whole or absent, numbered, the newest that passed in use, stale ones known."""

import json
import multiprocessing
import os
import signal
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.outcome import Outcome, RefusedError, plain, refused
from calibration.rig_file import rig_text
from calibration.store import KINDS, Provenance, Store, described
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError, InputError
from surfclass.fingerprint import DEPENDS, PARTS, changed, fingerprints
from surfclass.rig import parse_depth_rig, parse_rig

HAND_EYE = {"transforms": {"flange_T_depth": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}
FROM = Provenance("rec.mcap", {"rec.mcap": "ab"}, {}, {}, {"depth": "D1"})


@pytest.fixture(scope="module")
def rig():
    return parse_rig(truth.rig(SimWorld("grey_card", scale=0.1)), "rig")


def told(rig, kind="hand-eye", verdict="pass", values=None):
    values = HAND_EYE if values is None else values
    outcome = Outcome(kind, verdict, (), "0.1 mm", {"schema": 1}, values)
    return described(outcome, FROM, rig.with_values(values))


def test_the_newest_result_that_passed_is_in_use_and_older_ones_are_kept(tmp_path, rig):
    store = Store(tmp_path / "results")
    assert store.current("hand-eye") is None
    assert store.values() == {}
    first = store.add("hand-eye", told(rig))
    store.add("hand-eye", told(rig, verdict="fail"))
    assert store.current("hand-eye").path == first
    assert [one.number for one in store.results("hand-eye")] == [1, 2]
    assert store.values() == HAND_EYE
    assert store.current("hand-eye").devices == {"depth": "D1"}
    third = store.add("hand-eye", told(rig))
    assert store.current("hand-eye").path == third
    assert first.exists()
    third.unlink()
    assert store.current("hand-eye").path == first


def test_of_two_results_that_set_the_same_key_the_newer_holds(tmp_path, rig):
    store = Store(tmp_path)
    linear = {"response": {"inverse": [[0, 1]] * 3}}
    store.add("response", told(rig, "response", values=linear))
    store.add("light", told(rig, "light", values={"response": {"inverse": [[0, 0.4, 1]] * 3}}))
    assert store.values()["response"]["inverse"][0] == [0, 0.4, 1]
    store.add("response", told(rig, "response", values=linear))
    assert store.values()["response"]["inverse"][0] == [0, 1]


def test_a_new_hand_eye_makes_maps_stale_and_nothing_else(tmp_path, rig):
    before = fingerprints(rig)
    after = fingerprints(rig.with_values(HAND_EYE))
    assert {kind: changed(before, after, kind) for kind in DEPENDS} == {
        **{kind: [] for kind in DEPENDS},
        "map": ["hand-eye"],
    }


def test_every_key_that_a_step_finds_changes_its_own_fingerprint_alone(rig):
    moved = {
        "cameras": {"depth": {"fx": rig.depth.fx + 1}},
        "hand-eye": HAND_EYE,
        "response": {"response": {"inverse": [[0, 0.3, 1]] * 3}},
        "light": {"rgb": {"vignetting": [-1.0, 0, 0]}},
        "limits": {"texture_limits": {"far_m": 0.9}},
    }
    assert set(moved) == set(PARTS)
    before = fingerprints(rig)
    for part, values in moved.items():
        after = fingerprints(rig.with_values(values))
        assert {name for name in PARTS if before[name] != after[name]} == {part}


def test_a_default_that_is_written_out_is_no_change(rig):
    assert fingerprints(rig.with_values({"texture_limits": {"near_m": 0.5}})) == fingerprints(rig)


def test_a_rig_with_results_on_top_comes_back_from_its_text(rig):
    changed_rig = rig.with_values(HAND_EYE).with_values({"lens": {"f_number": 4}})
    assert parse_depth_rig(rig_text(changed_rig), "text") == changed_rig
    assert changed_rig.rgb == rig.rgb


def test_values_that_are_no_rig_are_refused_by_their_path(rig):
    with pytest.raises(ConfigurationError, match=r"light\.position_rgb_m"):
        rig.with_values({"light": {"position_rgb_m": [0, 0]}})


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=4),
        lambda below: st.lists(below, max_size=3) | st.dictionaries(st.text(max_size=3), below, max_size=3),
        max_leaves=12,
    )
)
def test_whatever_is_no_result_is_refused_by_its_file(value):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light" / "0001.json"
        path.parent.mkdir()
        path.write_text(json.dumps(value))
        with pytest.raises(InputError, match=r"0001\.json"):
            Store(Path(folder)).current("light")


@pytest.mark.parametrize("text", ["", "{", "\x00", '{"schema": 1, "kind": "cameras", "verdict": "pass"}'])
def test_a_damaged_file_is_refused_and_not_passed_over(tmp_path, text):
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "0001.json").write_text(text)
    with pytest.raises(InputError, match=r"0001\.json"):
        Store(tmp_path).values()


def test_results_of_another_kind_or_schema_are_refused(tmp_path, rig):
    (tmp_path / "cameras").mkdir()
    for wrong in ({"kind": "light"}, {"schema": 2}):
        text = json.dumps({**told(rig, "cameras", values={}), **wrong})
        (tmp_path / "cameras" / "0001.json").write_text(text)
        with pytest.raises(InputError, match="allowed here is schema 1, 'cameras'"):
            Store(tmp_path).current("cameras")


def test_a_result_that_is_not_finite_is_never_written(tmp_path, rig):
    with pytest.raises(ValueError, match="nan"):
        described(Outcome("light", "pass", (), "", {"sd": float("nan")}), FROM, rig)
    assert plain({"a": (1, 2.5)}) == {"a": [1, 2.5]}


def test_a_refusal_has_its_reasons_and_no_values():
    outcome = refused("hand-eye", RefusedError("too alike", "turn more", result={"poses": 3}))
    assert outcome.reasons == ("too alike", "turn more")
    assert outcome.result["verdict"] == "refused"
    assert outcome.result["poses"] == 3
    assert outcome.rig == {}


def _write_for_ever(directory, told):
    store = Store(directory)
    while True:
        store.add("hand-eye", told)


def test_whatever_moment_a_writer_is_killed_at_every_result_is_whole(tmp_path, rig):
    store, told_now = Store(tmp_path), told(rig)
    store.add("hand-eye", told_now)
    context = multiprocessing.get_context("fork")
    for wait_s in (0.0, 0.003, 0.01, 0.02, 0.05):
        writers = [context.Process(target=_write_for_ever, args=(tmp_path, told_now)) for _ in range(2)]
        for writer in writers:
            writer.start()
        time.sleep(wait_s)
        for writer in writers:
            os.kill(writer.pid, signal.SIGKILL)
            writer.join()
        results = store.results("hand-eye")
        assert [one.number for one in results] == list(range(1, len(results) + 1))
        assert all(dict(one.told) == told_now for one in results)
    assert store.current("hand-eye").number == len(store.results("hand-eye"))


def test_every_kind_that_is_kept_says_what_it_rests_on():
    assert set(KINDS) < set(DEPENDS)
    assert set(KINDS) == set(PARTS)
