"""The C structures and numbers of libdc1394 2.2 that `drivers.iidc.dc1394` uses."""

from __future__ import annotations

import ctypes
import enum
from ctypes import POINTER, c_char_p, c_float, c_int, c_uint32, c_uint64, c_void_p

LIBRARY = "libdc1394.so.25"
PACKAGE = "libdc1394-25"


class VideoMode(enum.IntEnum):
    """The modes whose pixels may be raw: one channel, not interpolated."""

    MONO8_640X480 = 69
    MONO16_640X480 = 70
    MONO8_800X600 = 73
    MONO8_1024X768 = 76
    MONO16_800X600 = 77
    MONO16_1024X768 = 78
    MONO8_1280X960 = 81
    MONO8_1600X1200 = 84
    MONO16_1280X960 = 85
    MONO16_1600X1200 = 86
    FORMAT7_0 = 88
    FORMAT7_1 = 89
    FORMAT7_2 = 90
    FORMAT7_3 = 91
    FORMAT7_4 = 92
    FORMAT7_5 = 93
    FORMAT7_6 = 94
    FORMAT7_7 = 95


class Coding(enum.IntEnum):
    """How a pixel is coded, of the codings with one channel."""

    MONO8 = 352
    MONO16 = 357
    RAW8 = 361
    RAW16 = 362


class Feature(enum.IntEnum):
    """What a camera can be told about the picture; all that IIDC 1.31 knows."""

    BRIGHTNESS = 416
    EXPOSURE = 417
    SHARPNESS = 418
    WHITE_BALANCE = 419
    HUE = 420
    SATURATION = 421
    GAMMA = 422
    SHUTTER = 423
    GAIN = 424
    IRIS = 425
    FOCUS = 426
    TEMPERATURE = 427
    TRIGGER = 428
    TRIGGER_DELAY = 429
    WHITE_SHADING = 430
    FRAME_RATE = 431
    ZOOM = 432
    PAN = 433
    TILT = 434
    OPTICAL_FILTER = 435
    CAPTURE_SIZE = 436
    CAPTURE_QUALITY = 437


MANUAL = 736  # of dc1394feature_mode_t
FRAME_RATES = {1.875: 32, 3.75: 33, 7.5: 34, 15.0: 35, 30.0: 36, 60.0: 37, 120.0: 38, 240.0: 39}  # Hz
COLOUR_FILTERS = {512: "RGGB", 513: "GBRG", 514: "GRBG", 515: "BGGR"}
TRIGGER_MODE_0 = 384  # an edge starts an exposure, the shutter ends it
TRIGGER_SOURCE_0 = 576
TRIGGER_SOURCE_SOFTWARE = 580
TRIGGER_ACTIVE_LOW, TRIGGER_ACTIVE_HIGH = 704, 705
ISO_SPEED_400 = 2
USE_MAX_AVAILABLE = -2  # for a packet size
CAPTURE_POLICY_POLL = 673
CAPTURE_FLAGS_DEFAULT = 4  # channel and bandwidth are taken on FireWire; USB has neither
LOG_ERROR, LOG_WARNING = 768, 769
FUNCTION_NOT_SUPPORTED = -3
FAILURE, IOCTL_FAILURE, RAW1394_FAILURE = -1, -9, -12


class CameraId(ctypes.Structure):
    """dc1394camera_id_t."""

    _fields_ = (("unit", ctypes.c_uint16), ("guid", c_uint64))


class CameraList(ctypes.Structure):
    """dc1394camera_list_t."""

    _fields_ = (("num", c_uint32), ("ids", POINTER(CameraId)))


class CameraInfo(ctypes.Structure):
    """dc1394camera_t."""

    _fields_ = (
        ("guid", c_uint64),
        ("unit", c_int),
        ("unit_spec_ID", c_uint32),
        ("unit_sw_version", c_uint32),
        ("unit_sub_sw_version", c_uint32),
        ("command_registers_base", c_uint32),
        ("unit_directory", c_uint32),
        ("unit_dependent_directory", c_uint32),
        ("advanced_features_csr", c_uint64),
        ("PIO_control_csr", c_uint64),
        ("SIO_control_csr", c_uint64),
        ("strobe_control_csr", c_uint64),
        ("format7_csr", c_uint64 * 8),
        ("iidc_version", c_int),
        ("vendor", c_char_p),
        ("model", c_char_p),
        ("vendor_id", c_uint32),
        ("model_id", c_uint32),
        ("bmode_capable", c_int),
        ("one_shot_capable", c_int),
        ("multi_shot_capable", c_int),
        ("can_switch_on_off", c_int),
        ("has_vmode_error_status", c_int),
        ("has_feature_error_status", c_int),
        ("max_mem_channel", c_int),
        ("flags", c_uint32),
    )


class VideoFrame(ctypes.Structure):
    """dc1394video_frame_t."""

    _fields_ = (
        ("image", c_void_p),
        ("size", c_uint32 * 2),
        ("position", c_uint32 * 2),
        ("color_coding", c_int),
        ("color_filter", c_int),
        ("yuv_byte_order", c_uint32),
        ("data_depth", c_uint32),
        ("stride", c_uint32),
        ("video_mode", c_int),
        ("total_bytes", c_uint64),
        ("image_bytes", c_uint32),
        ("padding_bytes", c_uint32),
        ("packet_size", c_uint32),
        ("packets_per_frame", c_uint32),
        ("timestamp", c_uint64),
        ("frames_behind", c_uint32),
        ("camera", c_void_p),
        ("id", c_uint32),
        ("allocated_image_bytes", c_uint64),
        ("little_endian", c_int),
        ("data_in_padding", c_int),
    )


class FeatureModes(ctypes.Structure):
    """dc1394feature_modes_t."""

    _fields_ = (("num", c_uint32), ("modes", c_int * 3))


class TriggerModes(ctypes.Structure):
    """dc1394trigger_modes_t."""

    _fields_ = (("num", c_uint32), ("modes", c_int * 8))


class TriggerSources(ctypes.Structure):
    """dc1394trigger_sources_t."""

    _fields_ = (("num", c_uint32), ("sources", c_int * 5))


class FeatureInfo(ctypes.Structure):
    """dc1394feature_info_t."""

    _fields_ = (
        ("id", c_int),
        ("available", c_int),
        ("absolute_capable", c_int),
        ("readout_capable", c_int),
        ("on_off_capable", c_int),
        ("polarity_capable", c_int),
        ("is_on", c_int),
        ("current_mode", c_int),
        ("modes", FeatureModes),
        ("trigger_modes", TriggerModes),
        ("trigger_mode", c_int),
        ("trigger_polarity", c_int),
        ("trigger_sources", TriggerSources),
        ("trigger_source", c_int),
        ("min", c_uint32),
        ("max", c_uint32),
        ("value", c_uint32),
        ("BU_value", c_uint32),
        ("RV_value", c_uint32),
        ("B_value", c_uint32),
        ("R_value", c_uint32),
        ("G_value", c_uint32),
        ("target_value", c_uint32),
        ("abs_control", c_int),
        ("abs_value", c_float),
        ("abs_max", c_float),
        ("abs_min", c_float),
    )


class VideoModes(ctypes.Structure):
    """dc1394video_modes_t."""

    _fields_ = (("num", c_uint32), ("modes", c_int * 32))


class FrameRates(ctypes.Structure):
    """dc1394framerates_t."""

    _fields_ = (("num", c_uint32), ("framerates", c_int * 8))


class ColourCodings(ctypes.Structure):
    """dc1394color_codings_t."""

    _fields_ = (("num", c_uint32), ("codings", c_int * 11))
