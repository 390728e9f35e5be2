"""What goes wrong with input: every message says what, where and what is allowed."""


class InputError(ValueError):
    """A file, frame, packet or request is not what it has to be; nothing was written."""


class ConfigurationError(InputError):
    """A configuration, rig, calibration or model cannot be used as it stands."""


class MissingCalibrationError(ConfigurationError):
    """A step needs a calibration that the rig does not have; the message says which and how to get it."""
