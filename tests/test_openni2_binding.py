"""The binding of OpenNI2, its runtime and the building of plug-ins."""

import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from openni2_cells import Counting

from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.openni2 import api, build, plugins
from drivers.openni2.device import Device
from drivers.openni2.errors import OpenNI2Error, PluginMissingError
from drivers.openni2.runtime import Runtime

try:
    plugins.system_folder()
    build.build("virtual")
except PluginMissingError as missing:
    pytest.skip(str(missing), allow_module_level=True)

oracle = pytest.importorskip("openni._openni2", reason="the oracle is not installed: PyPI package openni")

STRUCTURES = {
    api.Version: "OniVersion",
    api.VideoMode: "OniVideoMode",
    api.SensorInfo: "OniSensorInfo",
    api.DeviceInfo: "OniDeviceInfo",
    api.Frame: "OniFrame",
    api.DeviceCallbacks: "OniDeviceCallbacks",
}
NUMBERS = {
    api.Status: ("OniStatus", "ONI_STATUS_"),
    api.Sensor: ("OniSensorType", "ONI_SENSOR_"),
    api.PixelFormat: ("OniPixelFormat", "ONI_PIXEL_FORMAT_"),
    api.DeviceProperty: (None, "ONI_DEVICE_PROPERTY_"),
    api.StreamProperty: (None, "ONI_STREAM_PROPERTY_"),
}


@pytest.mark.parametrize("ours", STRUCTURES, ids=lambda each: each.__name__)
def test_structures_lie_in_memory_as_the_oracles_do(ours):
    theirs = getattr(oracle, STRUCTURES[ours])

    def layout(structure):
        fields = [getattr(structure, name) for name, *_ in structure._fields_]
        return [(field.offset, field.size) for field in fields]

    assert layout(ours) == layout(theirs)
    assert ctypes.sizeof(ours) == ctypes.sizeof(theirs)


@pytest.mark.parametrize("ours", NUMBERS, ids=lambda each: each.__name__)
def test_numbers_are_the_oracles(ours):
    group, prefix = NUMBERS[ours]
    for member in ours:
        name = prefix + member.name.replace("COLOUR", "COLOR")
        theirs = getattr(oracle, name, None) if group is None else getattr(getattr(oracle, group), name, None)
        if theirs is None:
            theirs = getattr(oracle, name)
        assert int(getattr(theirs, "value", theirs)) == member


def test_a_frame_is_what_the_oracle_reads(tmp_path):
    runtime = tmp_path / "runtime"
    (runtime / "OpenNI2" / "Drivers").mkdir(parents=True)
    (runtime / "libOpenNI2.so").symlink_to(plugins.system_folder() / api.LIBRARY)
    (runtime / "OpenNI2" / "Drivers" / "libvirtual.so.0").symlink_to(plugins.find("virtual"))
    script = """
import json, sys, zlib
from openni import openni2
openni2.initialize(sys.argv[1])
device = openni2.Device(sys.argv[2].encode())
told = {}
for name, stream in (("DEPTH", device.create_depth_stream()), ("IR", device.create_ir_stream())):
    stream.set_mirroring_enabled(False)
    stream.start()
    assert openni2.wait_for_any_stream([stream], 5.0) is not None
    frame = stream.read_frame()
    told[name] = frame.frameIndex, frame.timestamp, zlib.crc32(bytes(frame.get_buffer_as_uint8()))
    del frame
    stream.stop()
    stream.close()
device.close()
openni2.unload()
print(json.dumps(told))
"""
    seen = {}
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        command = [sys.executable, "-c", script, str(runtime), kinect.uri]
        run = subprocess.run(command, capture_output=True, timeout=60, check=True)
        truths = {truth.index: truth.timestamp_us for truth in kinect.exposures()}
        opened = Runtime(["virtual"])
        device = Device(opened, kinect.uri)
        for sensor in (api.Sensor.DEPTH, api.Sensor.IR):
            stream = device.create(sensor)
            stream.settle(api.StreamProperty.MIRRORING, 0)
            stream.start()
            assert device.wait([stream], 5.0) is stream
            seen[sensor.name] = stream.fetch()
        device.close()
        opened.close()
        truths |= {truth.index: truth.timestamp_us for truth in kinect.exposures()}
    theirs = json.loads(run.stdout.splitlines()[-1])
    for place, name in enumerate(("DEPTH", "IR")):
        index, stamp, checksum = theirs[name]
        assert stamp == truths[index]
        assert checksum == zlib.crc32(Counting().depth(0, index)[place].tobytes())
        assert seen[name].timestamp_us == truths[seen[name].index]
        assert np.array_equal(seen[name].pixels, Counting().depth(0, seen[name].index)[place])


def test_a_runtime_leaves_no_folder_behind_and_can_be_started_again_with_other_plugins():
    before = set(Path(tempfile.gettempdir()).glob("surfclass-openni2-*"))
    for drivers in (["OniFile"], ["virtual"], ["OniFile", "virtual"]):
        runtime = Runtime(drivers)
        assert runtime.version.startswith("2.")
        assert runtime.devices() == []
        runtime.close()
        runtime.close()
    assert set(Path(tempfile.gettempdir()).glob("surfclass-openni2-*")) <= before


def test_a_runtime_that_does_not_start_is_no_hindrance_to_the_next(tmp_path, monkeypatch):
    (tmp_path / "text").write_text("no library")
    monkeypatch.setattr(plugins, "find", lambda name: tmp_path / "text")
    for _ in range(2):
        with pytest.raises(OpenNI2Error, match="does not start"):
            Runtime(["OniFile"])
    monkeypatch.undo()
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        runtime = Runtime(["virtual"])
        Device(runtime, kinect.uri).close()
        runtime.close()


def test_it_runs_where_no_memory_may_be_written_and_run(tmp_path):
    """As in a systemd unit with MemoryDenyWriteExecute: callbacks need code of their own."""
    script = """
import ctypes, mmap, sys, time
if ctypes.CDLL(None).prctl(65, 1, 0, 0, 0) != 0:  # PR_SET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN
    sys.exit(77)
try:
    mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
except PermissionError:
    pass
else:
    sys.exit(77)
from drivers import depth_openni2
from drivers.clock import SystemClock
from drivers.errors import DeviceLostError
camera = depth_openni2.in_process(name="d", clock=SystemClock(), options={"device": sys.argv[1]}, shared={})
with camera:
    camera.grab(time.monotonic_ns(), 5.0)
    print("open", flush=True)
    sys.stdin.readline()
    until = time.monotonic() + 5
    try:
        while time.monotonic() < until:
            camera.check()
            time.sleep(0.02)
    except DeviceLostError:
        print("lost")
"""
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        command = [sys.executable, "-c", script, kinect.uri]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            first = process.stdout.readline()
            if not first and process.wait(30) == 77:
                pytest.skip("this kernel cannot deny memory that is written and run")
            assert first == "open\n"
            kinect.unplug()
            assert process.communicate("\n", timeout=30)[0] == "lost\n"


def test_there_is_one_runtime_at_a_time():
    first = Runtime(["OniFile"])
    with pytest.raises(OpenNI2Error, match="another camera"):
        Runtime(["OniFile"])
    first.close()
    Runtime(["OniFile"]).close()


def test_waiting_ends_at_the_timeout(tmp_path):
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        kinect.mute(True)
        runtime = Runtime(["virtual"])
        device = Device(runtime, kinect.uri)
        stream = device.create(api.Sensor.DEPTH)
        stream.start()
        assert device.wait([stream], 0.2) is None
        device.close()
        device.close()
        runtime.close()


def test_an_unknown_device_and_one_with_too_long_a_name_are_refused(tmp_path):
    runtime = Runtime(["virtual"])
    try:
        for uri in (f"virtual://{tmp_path}/none", "nonsense", "virtual://" + "x" * 300):
            with pytest.raises(OpenNI2Error):
                Device(runtime, uri)
    finally:
        runtime.close()


@pytest.mark.parametrize("content", [b"", b"x" * 200, b"SCKINECT" + b"\xff" * 120, b"SCKINECT" + b"\0" * 120])
def test_a_file_that_is_no_virtual_kinects_is_no_device(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    runtime = Runtime(["virtual"])
    try:
        with pytest.raises(OpenNI2Error):
            Device(runtime, f"virtual://{tmp_path}/file")
    finally:
        runtime.close()


def test_a_virtual_kinect_can_be_announced_by_the_environment(tmp_path, monkeypatch):
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        monkeypatch.setenv("SURFCLASS_VIRTUAL_KINECT", str(tmp_path / "kinect"))
        runtime = Runtime(["virtual"])
        assert [device.uri for device in runtime.devices()] == [kinect.uri]
        runtime.close()


class TestBuild:
    def test_what_is_current_is_left_alone(self, tmp_path):
        assert build.build("virtual", tmp_path)
        made = (tmp_path / "libvirtual.so.0").stat()
        assert not build.build("virtual", tmp_path)
        assert (tmp_path / "libvirtual.so.0").stat().st_mtime_ns == made.st_mtime_ns
        assert [path.name for path in tmp_path.iterdir()] == ["libvirtual.so.0"]

    def test_what_was_built_of_other_sources_or_headers_is_stale(self, tmp_path, monkeypatch):
        path = shutil.copy(plugins.find("virtual"), tmp_path / "libvirtual.so.0")
        sources, headers = plugins.built_of(path)
        for old, new in ((sources, "0" * 16), (headers, "1" * 16)):
            path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))
            monkeypatch.setattr(
                build, "_compile", lambda *_: (_ for _ in ()).throw(PluginMissingError("now"))
            )
            with pytest.raises(PluginMissingError, match="now"):
                build.build("virtual", tmp_path)
            monkeypatch.undo()
            path.write_bytes(path.read_bytes().replace(new.encode(), old.encode()))
        assert not build.build("virtual", tmp_path)

    def test_a_plugin_that_is_not_built_or_stale_says_how_to_build_it(self, tmp_path, monkeypatch):
        monkeypatch.setattr(plugins, "build_folder", lambda: tmp_path)
        with pytest.raises(PluginMissingError, match=r"not built.*python -m drivers\.openni2\.build"):
            plugins.find("virtual")
        (tmp_path / "libvirtual.so.0").write_bytes(b"surfclass-plugin:" + b"0" * 16 + b"-" + b"0" * 16)
        with pytest.raises(PluginMissingError, match=r"another version.*python -m drivers\.openni2\.build"):
            plugins.find("virtual")

    def test_a_missing_compiler_and_missing_headers_name_their_packages(self, tmp_path, monkeypatch):
        monkeypatch.setattr(build, "_INCLUDES", (tmp_path,))
        with pytest.raises(PluginMissingError, match="libopenni2-dev"):
            build.build("virtual", tmp_path)
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(PluginMissingError, match=r"package g\+\+"):
            build.build("virtual", tmp_path)

    def test_a_failing_compiler_and_a_bad_folder_leave_nothing(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr(build, "_FLAGS", ("-fno-such-flag",))
        with pytest.raises(PluginMissingError, match="no-such-flag"):
            build.build("virtual", tmp_path)
        assert list(tmp_path.iterdir()) == []
        (tmp_path / "file").touch()
        with pytest.raises(PluginMissingError, match="cannot be written"):
            build.build("virtual", tmp_path / "file" / "folder")
        monkeypatch.setattr(build, "build_folder", lambda: tmp_path / "file" / "folder")
        assert build.main(["virtual"]) == 69
        assert "virtual" in capsys.readouterr().err
