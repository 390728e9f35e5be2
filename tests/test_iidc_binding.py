"""The ctypes binding against libdc1394's own headers, and the library on a computer without a camera."""

import ctypes
import ctypes.util
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from drivers.clock import SystemClock
from drivers.colour_iidc import colour, in_process
from drivers.errors import DeviceNotFoundError, DriverUnavailableError
from drivers.iidc import dc1394_types as types

HEADERS = Path("/usr/include/dc1394/dc1394.h")
OPTIONS = {"exposure_us": 5000.0, "gain_db": 0.0}

STRUCTURES = {
    types.CameraId: "dc1394camera_id_t",
    types.CameraList: "dc1394camera_list_t",
    types.CameraInfo: "dc1394camera_t",
    types.VideoFrame: "dc1394video_frame_t",
    types.FeatureModes: "dc1394feature_modes_t",
    types.TriggerModes: "dc1394trigger_modes_t",
    types.TriggerSources: "dc1394trigger_sources_t",
    types.FeatureInfo: "dc1394feature_info_t",
    types.VideoModes: "dc1394video_modes_t",
    types.FrameRates: "dc1394framerates_t",
    types.ColourCodings: "dc1394color_codings_t",
}


def numbers():
    """The C names of the binding's numbers."""
    for mode in types.VideoMode:
        first, *rest = mode.name.split("_")
        name = f"{rest[0].replace('X', 'x')}_{first}" if first.startswith("MONO") else mode.name
        yield f"DC1394_VIDEO_MODE_{name}", mode.value
    for coding in types.Coding:
        yield f"DC1394_COLOR_CODING_{coding.name}", coding.value
    for feature in types.Feature:
        yield f"DC1394_FEATURE_{feature.name}", feature.value
    for rate, code in types.FRAME_RATES.items():
        yield f"DC1394_FRAMERATE_{f'{rate:g}'.replace('.', '_')}", code
    for code, pattern in types.COLOUR_FILTERS.items():
        yield f"DC1394_COLOR_FILTER_{pattern}", code
    yield "DC1394_FEATURE_MODE_MANUAL", types.MANUAL
    yield "DC1394_LOG_ERROR", types.LOG_ERROR
    yield "DC1394_LOG_WARNING", types.LOG_WARNING
    yield "DC1394_USE_MAX_AVAIL", types.USE_MAX_AVAILABLE
    for name in (
        "TRIGGER_MODE_0", "TRIGGER_SOURCE_0", "TRIGGER_SOURCE_SOFTWARE", "TRIGGER_ACTIVE_LOW",
        "TRIGGER_ACTIVE_HIGH", "ISO_SPEED_400", "CAPTURE_POLICY_POLL", "CAPTURE_FLAGS_DEFAULT", "FAILURE",
        "IOCTL_FAILURE", "RAW1394_FAILURE", "FUNCTION_NOT_SUPPORTED",
    ):  # fmt: skip
        yield f"DC1394_{name}", getattr(types, name)


def test_structures_and_numbers_are_those_of_the_headers(tmp_path):
    if shutil.which("gcc") is None or not HEADERS.exists():
        pytest.skip("needs gcc and libdc1394-dev, to ask the C compiler")
    lines, expected = [], []
    for structure, name in STRUCTURES.items():
        lines.append(f'printf("%zu\\n", sizeof({name}));')
        expected.append((f"sizeof {name}", ctypes.sizeof(structure)))
        for field, _ in structure._fields_:
            lines.append(f'printf("%zu\\n", offsetof({name}, {field}));')
            expected.append((f"{name}.{field}", getattr(structure, field).offset))
            lines.append(f'printf("%zu\\n", sizeof((({name} *)0)->{field}));')
            expected.append((f"sizeof {name}.{field}", getattr(structure, field).size))
    for name, value in numbers():
        lines.append(f'printf("%lld\\n", (long long){name});')
        expected.append((name, value))
    source = "#include <stdio.h>\n#include <stddef.h>\n#include <dc1394/dc1394.h>\nint main(void) {\n"
    (tmp_path / "ask.c").write_text(source + "\n".join(lines) + "\nreturn 0;\n}\n")
    subprocess.run(["gcc", "-o", tmp_path / "ask", tmp_path / "ask.c"], check=True, timeout=60)
    told = subprocess.run([tmp_path / "ask"], capture_output=True, text=True, check=True, timeout=10)
    found = [(name, int(line)) for (name, _), line in zip(expected, told.stdout.split(), strict=True)]
    assert found == expected


def test_every_function_of_the_binding_is_in_the_headers_with_as_many_arguments():
    if not HEADERS.exists():
        pytest.skip("needs libdc1394-dev")
    from drivers.iidc.dc1394 import CALLS

    text = "".join(path.read_text(errors="replace") for path in HEADERS.parent.glob("*.h"))
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    for name, arguments in CALLS.items():
        declared = re.search(rf"\bdc1394_{name}\s*\(([^)]*)\)", text)
        assert declared is not None, name
        assert declared[1].count(",") == len(arguments), name


def test_without_a_camera_opening_says_so_at_once():
    if ctypes.util.find_library("dc1394") is None:
        pytest.skip("needs libdc1394-25")
    if any(Path("/sys/bus/usb/devices").glob("*/idVendor")):
        pytest.skip("there is USB here, and a camera may be on it")
    camera = colour(name="colour", clock=SystemClock(), options=OPTIONS, shared={})
    for _ in range(2):
        before = time.monotonic()
        with pytest.raises(DeviceNotFoundError, match="no camera"):
            camera.open()
        assert time.monotonic() - before < 10
        assert not camera.is_open
    assert camera.pid is None


def test_a_missing_library_is_told_with_its_package(monkeypatch):
    monkeypatch.setattr("drivers.iidc.dc1394.LIBRARY", "libdc1394.so.none")
    camera = in_process(name="colour", clock=SystemClock(), options=OPTIONS, shared={})
    with pytest.raises(DriverUnavailableError, match="libdc1394-25"):
        camera.open()
    assert not camera.is_open
