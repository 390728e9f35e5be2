"""The demo's first part: a simulated package is commissioned step by step, and compared with its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table

from calibration.outcome import Kind
from calibration.rotations import difference
from daemon import commissioning_steps as steps
from daemon import wiring
from daemon.commissioning import Call
from daemon.config import load_config
from daemon.offline import console
from drivers.files import write_atomically
from drivers.sim import nominal, truth
from drivers.sim.package import Package
from drivers.sim.world import SimWorld
from surfclass.errors import InputError
from surfclass.rig import Rig

CONFIG = "commissioning.toml"


def commission_simulated(out: Path, seed: int) -> str:
    """Commissions the package from data-sheet numbers, each step on its target; returns the rig's text.

    Args:
        out: Where the configuration, the captures and the results go.
        seed: Of the simulated world.

    Raises:
        InputError: If a step does not pass.
    """
    world = SimWorld("cell", seed)
    write_atomically(out / "nominal.toml", nominal.rig(world).encode())
    write_atomically(out / "plate.toml", truth.plate_toml(SimWorld("reflector_discs", seed)).encode())
    write_atomically(out / "board.toml", truth.board_toml().encode())
    write_atomically(out / CONFIG, _CONFIG.encode())
    told = steps.BoardTold(None, None, None, None)

    def call(kind: Kind, scene: str) -> Call:
        console.rule(f"[bold]surfclass calibrate {kind}[/bold] --set sim.scene={scene}", style="dim")
        overrides = [f"sim.scene={scene}", f"sim.seed={seed}"]
        pictures = out / "commissioned" / "pictures"
        return replace(steps.call(kind, out / CONFIG, overrides, None, None, None, pictures), page=False)

    run: list[Callable[[], int]] = [
        lambda: steps.cameras(call("cameras", "checkerboard"), told),
        lambda: steps.hand_eye(call("hand-eye", "reflector_discs"), None, "discs", told),
        lambda: steps.response(call("response", "exposure_card")),
        lambda: steps.light(call("light", "highlight_board"), "boards"),
    ]
    for step in run:
        if step() != 0:
            raise InputError("a step of commissioning did not pass; see above")
    text, rig = wiring.rig_of(load_config(out / CONFIG, [f"sim.seed={seed}"]))
    _compare(rig, world.package)
    return text


def _compare(rig: Rig, package: Package) -> None:
    """Prints how far each result is from the simulation's truth."""
    table = Table(title="commissioned, against the simulation's truth", title_justify="left")
    table.add_column("what")
    table.add_column("off by", justify="right")
    for camera, found, true in (("rgb", rig.rgb, package.rgb), ("depth", rig.depth, package.depth)):
        focal = 100 * max(abs(found.fx / true.fx - 1), abs(found.fy / true.fy - 1))
        table.add_row(f"{camera}: focal lengths", f"{focal:.3f} %")
        centre = np.hypot(found.cx - true.cx, found.cy - true.cy)
        table.add_row(f"{camera}: principal point", f"{centre:.2f} px")
    for name, transform, truth_ in (
        ("rgb_T_depth", rig.rgb_T_depth, package.rgb_T_depth),
        ("flange_T_depth", rig.flange_T_depth, package.flange_T_depth),
    ):
        off = difference(transform, truth_)
        turn, shift = np.degrees(np.linalg.norm(off[:3])), 1e3 * np.linalg.norm(off[3:])
        table.add_row(name, f"{shift:.2f} mm, {turn:.3f}°")
    if rig.light is not None:
        away = np.array(rig.light.position_rgb_m) - package.led.position_m
        table.add_row("light", f"{1e3 * np.linalg.norm(away):.2f} mm")
    console.print(table)


_CONFIG = """\
schema = 1
robot = "demo"
rig = "nominal.toml"
model = "model.npz"

[calibration]
directory = "commissioned"
plate = "plate.toml"
board = "board.toml"

[colour]
backend = "sim"
[depth]
backend = "sim"
[light]
backend = "sim"
[arm]
backend = "sim"
[sim]
"""
