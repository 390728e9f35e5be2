"""What `check` and `calibrate --status` say of results that are current, stale, or of another camera."""

import pytest

from calibration.outcome import Outcome
from calibration.store import Provenance, Store, described
from daemon.check_calibration import check_calibration, check_serials
from daemon.commissioning_status import status
from daemon.config import load_config
from daemon.findings import Notes, Verdict
from daemon.wiring import rig_of
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.fingerprint import fingerprints
from surfclass.map_file import to_npz_bytes
from surfclass.rig import SurfaceClasses, parse_rig
from surfclass.voxel_map import VoxelMap

MOVED = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
VALUES = {
    "cameras": {"depth": {"fx": 60.0}},
    "hand-eye": {"transforms": {"flange_T_depth": MOVED}},
}
FROM = Provenance("rec.mcap", {}, {}, {}, {"colour": "A1", "depth": "D1"})


@pytest.fixture
def site(tmp_path):
    """A configuration whose rig is a file, and an empty directory of results."""
    (tmp_path / "rig.toml").write_text(truth.rig(SimWorld("grey_card", scale=0.1)))
    (tmp_path / "surfclass.toml").write_text(
        'schema = 1\nrig = "rig.toml"\nmodel = "model.npz"\nmap = "map.npz"\n'
        '[calibration]\ndirectory = "kept"\n[colour]\nbackend = "sim"\n[depth]\nbackend = "sim"\n'
    )
    return tmp_path


def found(site, kind, values=None):
    """Adds a result that passed, made with the rig that is in use."""
    store = Store(site / "kept")
    values = VALUES[kind] if values is None else values
    rig = parse_rig((site / "rig.toml").read_text(), "rig").with_values(store.values()).with_values(values)
    store.add(kind, described(Outcome(kind, "pass", (), "", {"schema": 1}, values), FROM, rig))


def said(site):
    findings = []
    check_calibration(load_config(site / "surfclass.toml"), Notes(findings))
    return findings


def test_the_results_in_use_are_on_top_of_the_rig_and_in_its_text(site):
    config = load_config(site / "surfclass.toml")
    assert rig_of(config)[0] == (site / "rig.toml").read_text()
    found(site, "hand-eye")
    text, rig = rig_of(config)
    assert rig.flange_T_depth.matrix.tolist() == MOVED
    assert parse_rig(text, "text") == rig


def test_a_step_that_rests_on_another_is_stale_when_that_is_redone_and_current_when_it_is_too(site):
    found(site, "cameras")
    found(site, "hand-eye")
    assert [finding.verdict for finding in said(site)] == [Verdict.OK]
    found(site, "cameras", {"depth": {"fx": 61.0}})
    _, stale = said(site)
    assert "hand-eye is older than the cameras" in stale.message
    assert stale.advice == "surfclass calibrate hand-eye"
    found(site, "hand-eye")
    assert [finding.verdict for finding in said(site)] == [Verdict.OK]


def test_cameras_that_come_out_the_same_again_make_nothing_stale(site):
    found(site, "cameras")
    found(site, "hand-eye")
    found(site, "cameras")
    assert [finding.verdict for finding in said(site)] == [Verdict.OK]


def test_a_map_of_before_the_new_hand_eye_is_stale(site):
    rig = parse_rig((site / "rig.toml").read_text(), "rig")
    classes = SurfaceClasses(names=("a", "b"), colours=("#000000", "#ffffff"))
    (site / "map.npz").write_bytes(to_npz_bytes(VoxelMap(0.01, classes, made_with=fingerprints(rig))))
    assert [finding.verdict for finding in said(site)] == [Verdict.OK]
    found(site, "hand-eye")
    assert "made before the new hand-eye" in said(site)[-1].message
    told = status(site / "kept", rig.with_values(VALUES["hand-eye"]), None, [site / "map.npz"])
    assert told["made"][str(site / "map.npz")]["stale_since"] == ["hand-eye"]


def test_without_a_rig_the_results_are_compared_with_each_other(site):
    found(site, "cameras")
    found(site, "hand-eye")
    found(site, "cameras", {"depth": {"fx": 61.0}})
    told = status(site / "kept", None, None, [])
    assert told["results"]["hand-eye"]["stale_since"] == ["cameras"]
    assert told["results"]["cameras"]["older"] == 1


def test_a_camera_that_is_not_the_calibrated_one_is_wrong(site):
    found(site, "cameras")
    config = load_config(site / "surfclass.toml")
    for serial, verdicts in (("A1", []), ("B2", [Verdict.CONFIGURATION])):
        devices, findings = [], []
        Notes(devices).ok("colour", "works", {"serial": serial})
        check_serials(config, devices, Notes(findings))
        assert [finding.verdict for finding in findings] == verdicts


def test_a_damaged_result_is_named_and_ends_the_service_as_a_configuration_does(site):
    (site / "kept" / "light").mkdir(parents=True)
    (site / "kept" / "light" / "0001.json").write_text("{")
    (finding,) = said(site)
    assert finding.verdict is Verdict.CONFIGURATION
    assert "0001.json" in finding.message
