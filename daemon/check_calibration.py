"""The part of `surfclass check` that asks whether what commissioning found is still true."""

from __future__ import annotations

from collections.abc import Mapping

from calibration.store import KINDS, Store
from daemon import wiring
from daemon.commissioning_status import status
from daemon.config import Config
from daemon.findings import Finding, Notes


def check_calibration(config: Config, note: Notes) -> None:
    """Says which results are in use, which are stale, and which steps were never done."""
    if config.calibration is None or config.replay is not None:
        return
    directory = config.calibration.directory
    with note.faults_of("calibration", "move the file that the message names away"):
        maps = [config.map] if config.map is not None and config.map.exists() else []
        rig = wiring.depth_rig_of(config)[1]
        told = status(directory, rig, config.model, maps)
        results = told["results"]
        done = [kind for kind in KINDS if results[kind]["file"] is not None]
        note.ok("calibration", f"{directory}: {', '.join(done) or 'no results, all is from the rig file'}")
        for kind in done:
            if results[kind]["stale_since"]:
                changes = ", ".join(results[kind]["stale_since"])
                advice = f"surfclass calibrate {kind}"
                note.warn("calibration", f"{kind} is older than the {changes} that it rests on", advice)
        for path, made in told["made"].items():
            if made["stale_since"]:
                changes = ", ".join(made["stale_since"])
                advice = "train again" if made["what"] == "model" else "map again"
                note.warn("calibration", f"{path} was made before the new {changes}", advice)


def check_serials(config: Config, findings: list[Finding], note: Notes) -> None:
    """Warns where a camera is not the one that was calibrated.

    Args:
        config: Where the results are.
        findings: Those of the devices, with the facts that each tells about itself.
        note: Where to say it.
    """
    if config.calibration is None:
        return
    in_use = Store(config.calibration.directory).current("cameras")
    if in_use is None:
        return
    told: dict[str, Mapping[str, str]] = {one.subject: one.facts for one in findings if one.facts}
    for camera in ("colour", "depth"):
        there, expected = told.get(camera, {}).get("serial"), in_use.devices.get(camera)
        if there is not None and expected is not None and there != expected:
            note.wrong(
                camera,
                f"serial {there}, but the calibration in use ({in_use.path}) is of {expected}",
                "surfclass calibrate cameras --new-devices, and what rests on it",
            )
