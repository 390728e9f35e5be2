"""Free network ports that stay free while an emulated device is unplugged."""

from __future__ import annotations

import random
import socket

from surfclass.errors import ConfigurationError

# Below what Linux gives to outgoing connections by itself (32768…60999): one of those may take any port
# there while nobody listens, and the device could not come back.
_FIRST, _LAST = 20_000, 32_000
_TRIES = 100


def free_port(host: str = "127.0.0.1") -> int:
    """Returns a port of `host` that neither TCP nor UDP uses now.

    Raises:
        ConfigurationError: If none was found.
    """
    for _ in range(_TRIES):
        port = random.randint(_FIRST, _LAST)
        try:
            for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind((host, port))
        except OSError:
            continue
        return port
    raise ConfigurationError(f"no free port of {host} from {_FIRST} to {_LAST}")
