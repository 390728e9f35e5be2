"""The simulated package before anybody has calibrated it: what data sheets and a ruler say."""

from __future__ import annotations

from drivers.sim.world import SimWorld

# Off by what such numbers are off by: focal lengths by 1–2 %, the principal point assumed in the middle,
# the cameras assumed parallel.
_RGB_FOCAL_PX, _DEPTH_FOCAL_PX = 1600.0, 575.0
_APART_M = 0.08


def rig(world: SimWorld) -> str:
    """Returns the text of `rig.toml` to begin commissioning with: no distortion, no hand-eye, no light."""
    package = world.package
    lines = ["schema = 1", f'name = "simulated {world.scene.name}"', "voxel_size_m = 0.010"]
    for table, camera, full_width, focal in (
        ("rgb", package.rgb, 1280, _RGB_FOCAL_PX),
        ("depth", package.depth, 640, _DEPTH_FOCAL_PX),
    ):
        width, height = camera.size
        lines += [
            f"[{table}]",
            f"size = [{width}, {height}]",
            f"fx = {focal * width / full_width!r}",
            f"fy = {focal * width / full_width!r}",
            f"cx = {(width - 1) / 2}",
            f"cy = {(height - 1) / 2}",
        ]
    lines += [
        "[transforms]",
        (
            f"rgb_T_depth = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, {_APART_M}], [0.0, 0.0, 1.0, 0.0], "
            "[0.0, 0.0, 0.0, 1.0]]"
        ),
        "[lens]",
        f"focal_length_m = {package.focal_length_m}",
        f"f_number = {package.f_number}",
        f"focus_distance_m = {package.focus_distance_m}",
        f"circle_of_confusion_m = {package.circle_of_confusion_m}",
        "[arm]",
        f"flange_offset_m = {package.flange_offset_m}",
    ]
    return "\n".join(lines) + "\n"
