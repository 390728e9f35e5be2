"""Builds the project's OpenNI2 plug-ins with g++: `python -m drivers.openni2.build`, run at set-up.

What is current is left alone; one is stale when the sources here or the system's headers are others.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from drivers.openni2.errors import PluginMissingError
from drivers.openni2.plugins import OWN, SOURCES, build_folder, built_of, sources_digest

_SYSTEM_INCLUDES = Path("/usr/include")
_INCLUDES = (_SYSTEM_INCLUDES / "openni2", _SYSTEM_INCLUDES / "libusb-1.0")
_FLAGS = ("-std=c++17", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra")
_LIBRARIES = {"kinect1": ("-lfreenect",), "virtual": ()}
# The headers that fix the interface, and the Debian package of each.
_OPENNI2_HEADERS = {"Driver/OniDriverAPI.h": "libopenni2-dev", "OniCTypes.h": "libopenni2-dev"}
_FREENECT_HEADERS = {"libfreenect.h": "libfreenect-dev", "libfreenect_registration.h": "libfreenect-dev"}
_HEADERS = {"kinect1": _OPENNI2_HEADERS | _FREENECT_HEADERS, "virtual": _OPENNI2_HEADERS}
_TIMEOUT_S = 300.0


def build(name: str, folder: Path | None = None) -> bool:
    """Builds one plug-in where it is missing or stale; whoever has it loaded keeps the old one.

    Args:
        name: One of `OWN`.
        folder: Where to; None: `build_folder()`.

    Returns:
        Whether it was built now.

    Raises:
        PluginMissingError: If the compiler, a header or a library is missing (with the Debian
            package), the compiler fails, or the folder cannot be written.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        raise PluginMissingError("no compiler; install the Debian package g++")
    target = (folder or build_folder()) / f"lib{name}.so.0"
    digests = sources_digest(name), _headers_digest(name)
    if built_of(target) == digests:
        return False
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".building-") as work:
            made = Path(work) / target.name
            _compile(compiler, name, "-".join(digests), made)
            made.chmod(0o755)
            made.replace(target)
    except OSError as error:
        raise PluginMissingError(f"{target} cannot be written: {error.strerror or error}") from None
    return True


def _headers_digest(name: str) -> str:
    digest = hashlib.sha256()
    for header, package in _HEADERS[name].items():
        found = [folder / header for folder in (*_INCLUDES, _SYSTEM_INCLUDES) if (folder / header).is_file()]
        if not found:
            raise PluginMissingError(f"no {header}; install the Debian package {package}")
        digest.update(found[0].read_bytes())
    return digest.hexdigest()[:16]


def _compile(compiler: str, name: str, digest: str, made: Path) -> None:
    includes = [f"-isystem{folder}" for folder in _INCLUDES]
    command = [compiler, *_FLAGS, *includes, f'-DSURFCLASS_DIGEST="{digest}"']
    command += ["-o", str(made), str(SOURCES / f"{name}.cpp"), "-pthread", *_LIBRARIES[name]]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        raise PluginMissingError(f"g++ took longer than {_TIMEOUT_S:g} s for {name}.cpp") from None
    if run.returncode != 0:
        raise PluginMissingError(f"g++ failed on {name}.cpp:\n{run.stderr.strip()[-4000:]}")


def main(arguments: list[str] | None = None) -> int:
    """Builds all plug-ins, or those named; 0 if all are current then, 69 if one cannot be built."""
    parser = argparse.ArgumentParser(prog="python -m drivers.openni2.build", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="PLUGIN", help=f"of {', '.join(OWN)}; default: all")
    parser.add_argument("--quiet", action="store_true", help="say nothing unless one cannot be built")
    chosen = parser.parse_args(arguments)
    names = chosen.names or OWN
    unknown = sorted(set(names) - set(OWN))
    if unknown:
        parser.error(f"no plug-in {', '.join(unknown)}; there are {', '.join(OWN)}")
    failed = False
    for name in names:
        try:
            if build(name) and not chosen.quiet:
                print(f"built {build_folder() / f'lib{name}.so.0'}")
        except PluginMissingError as error:
            print(f"OpenNI2 plug-in {name}: {error}", file=sys.stderr)
            failed = True
    return 69 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
