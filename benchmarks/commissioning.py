"""Commissions the simulated cell over several seeds, live, and compares every result with the truth.

Each seed draws all noise and all textures anew. Prints for each seed how far each result is off, and
the most of its reported standard deviations that any component is off by; then the rms over the seeds.

    python -m benchmarks.commissioning [FIRST] [COUNT]
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from pathlib import Path

import numpy as np

from calibration.rotations import difference
from calibration.store import Store
from daemon.demo_commissioning import commission_simulated
from drivers.sim.world import SimWorld
from surfclass.rig import Rig, parse_rig

NAMES = (
    "rgb_T_depth mm",
    "rgb_T_depth deg",
    "hand-eye mm",
    "hand-eye deg",
    "light mm",
    "focal %",
    "centre px",
)


def errors(rig: Rig, store: Store, seed: int) -> tuple[list[float], list[float]]:
    """How far each is off, and the largest number of standard deviations of cameras, hand-eye and light."""
    package = SimWorld("cell", seed).package
    between = difference(rig.rgb_T_depth, package.rgb_T_depth)
    hand_eye = difference(rig.flange_T_depth, package.flange_T_depth)
    assert rig.light is not None
    light = np.array(rig.light.position_rgb_m) - package.led.position_m
    results = [store.current("cameras"), store.current("hand-eye"), store.current("light")]
    told = {one.kind: one.told for one in results if one is not None}
    sd = {"cameras": told["cameras"]["extrinsic_sd"], "hand-eye": told["hand-eye"]["jackknife_sd"]}
    sigmas = []
    for off, kind in ((between, "cameras"), (hand_eye, "hand-eye")):
        spread = np.array([*sd[kind]["rotation_rad"], *sd[kind]["translation_m"]])
        sigmas.append(float(np.abs(off / spread).max()))
    sigmas.append(float(np.abs(light / np.array(told["light"]["sd"]["position_m"])).max()))
    cameras = ((rig.rgb, package.rgb), (rig.depth, package.depth))
    focal = max(abs(getattr(a, key) / getattr(b, key) - 1) for a, b in cameras for key in ("fx", "fy"))
    centre = max(float(np.hypot(a.cx - b.cx, a.cy - b.cy)) for a, b in cameras)
    off = [
        1e3 * float(np.linalg.norm(between[3:])),
        float(np.degrees(np.linalg.norm(between[:3]))),
        1e3 * float(np.linalg.norm(hand_eye[3:])),
        float(np.degrees(np.linalg.norm(hand_eye[:3]))),
        1e3 * float(np.linalg.norm(light)),
        100 * focal,
        centre,
    ]
    return off, sigmas


def main() -> None:
    first, count = (int(value) for value in (*sys.argv[1:3], "0", "3")[:2])
    heads = "  ".join(f"{name:>15}" for name in NAMES)
    print(f"seed  {heads}   sigmas: between, hand-eye, light", flush=True)
    rows, all_sigmas = [], []
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
            rig = parse_rig(commission_simulated(Path(folder), seed), "commissioned")
            off, sigmas = errors(rig, Store(Path(folder) / "commissioned"), seed)
        rows.append(off)
        all_sigmas.append(sigmas)
        figures = "  ".join(f"{value:15.3f}" for value in off)
        print(f"{seed:4d}  {figures}   {np.round(sigmas, 2)}", flush=True)
    rms = np.sqrt(np.mean(np.square(rows), axis=0))
    print(" rms  " + "  ".join(f"{value:15.3f}" for value in rms))
    print(f"worst sigmas: {np.round(np.max(all_sigmas, axis=0), 2)}")


if __name__ == "__main__":
    main()
