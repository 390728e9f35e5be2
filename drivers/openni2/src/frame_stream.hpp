// What the streams of both plug-ins share: their properties, and handing frames to the runtime.
#pragma once

#include <OniCEnums.h>
#include <OniCProperties.h>
#include <Driver/OniDriverAPI.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <mutex>
#include <vector>

// Debian's headers use these two and do not define them.
#define XN_NEW(type, ...) new type(__VA_ARGS__)
#define XN_DELETE(pointer) delete (pointer)

// The build puts a digest of sources and headers here; whoever loads a plug-in looks for it in the file.
extern "C" __attribute__((used, visibility("default"))) const char surfclass_plugin[] =
    "surfclass-plugin:" SURFCLASS_DIGEST;

namespace surfclass {

struct FieldOfView {
  float horizontal, vertical;  // rad
};

template <typename Value>
OniStatus give(const Value& value, void* data, int* size) {
  if (*size < static_cast<int>(sizeof value)) return ONI_STATUS_BAD_PARAMETER;
  std::memcpy(data, &value, sizeof value);
  *size = sizeof value;
  return ONI_STATUS_OK;
}

template <typename Value>
bool take(Value& value, const void* data, int size) {
  if (size != static_cast<int>(sizeof value)) return false;
  std::memcpy(&value, data, sizeof value);
  return true;
}

inline OniStatus give_text(const char* text, void* data, int* size) {
  const int needed = static_cast<int>(std::strlen(text)) + 1;
  if (*size < needed) return ONI_STATUS_BAD_PARAMETER;
  std::memcpy(data, text, needed);
  *size = needed;
  return ONI_STATUS_OK;
}

// A stream of 16-bit pixels. Frames come from one thread of the plug-in, start() and stop() from the
// application's.
class FrameStream : public oni::driver::StreamBase {
 public:
  FrameStream(OniSensorType sensor, std::vector<OniVideoMode> modes, FieldOfView fov, int max_value)
      : sensor_(sensor), modes_(std::move(modes)), mode_(modes_.front()), fov_(fov), max_value_(max_value) {}

  OniStatus start() override {
    on_ = true;
    return ONI_STATUS_OK;
  }

  // When it returns, no frame is on its way. It waits with a bound: an application that unloads the
  // runtime without closing its streams holds the lock that the frame under way is waiting for.
  void stop() override {
    on_ = false;
    if (delivery_.try_lock_for(std::chrono::seconds(2))) delivery_.unlock();
  }

  OniBool isPropertySupported(int id) override {
    switch (id) {
      case ONI_STREAM_PROPERTY_VIDEO_MODE:
      case ONI_STREAM_PROPERTY_HORIZONTAL_FOV:
      case ONI_STREAM_PROPERTY_VERTICAL_FOV:
      case ONI_STREAM_PROPERTY_MAX_VALUE:
      case ONI_STREAM_PROPERTY_MIN_VALUE:
      case ONI_STREAM_PROPERTY_STRIDE:
      case ONI_STREAM_PROPERTY_CROPPING:
      case ONI_STREAM_PROPERTY_MIRRORING:
        return TRUE;
      default:
        return FALSE;
    }
  }

  OniStatus getProperty(int id, void* data, int* size) override {
    switch (id) {
      case ONI_STREAM_PROPERTY_VIDEO_MODE: return give(mode_, data, size);
      case ONI_STREAM_PROPERTY_HORIZONTAL_FOV: return give(fov_.horizontal, data, size);
      case ONI_STREAM_PROPERTY_VERTICAL_FOV: return give(fov_.vertical, data, size);
      case ONI_STREAM_PROPERTY_MAX_VALUE: return give(max_value(), data, size);
      case ONI_STREAM_PROPERTY_MIN_VALUE: return give(0, data, size);
      case ONI_STREAM_PROPERTY_STRIDE: return give(stride(), data, size);
      case ONI_STREAM_PROPERTY_CROPPING: return give(whole(), data, size);
      case ONI_STREAM_PROPERTY_MIRRORING: return give(mirrored(), data, size);
      default: return ONI_STATUS_NOT_SUPPORTED;
    }
  }

  OniStatus setProperty(int id, const void* data, int size) override {
    if (id == ONI_STREAM_PROPERTY_VIDEO_MODE) {
      OniVideoMode wanted;
      if (!take(wanted, data, size)) return ONI_STATUS_BAD_PARAMETER;
      if (on_) return ONI_STATUS_OUT_OF_FLOW;
      for (const OniVideoMode& mode : modes_) {
        if (std::memcmp(&mode, &wanted, sizeof mode) == 0) {
          mode_ = mode;
          return ONI_STATUS_OK;
        }
      }
      return ONI_STATUS_NOT_SUPPORTED;
    }
    if (id == ONI_STREAM_PROPERTY_MIRRORING) {
      OniBool wanted;
      if (!take(wanted, data, size)) return ONI_STATUS_BAD_PARAMETER;
      return mirror(wanted != FALSE);
    }
    return ONI_STATUS_NOT_SUPPORTED;
  }

  // A recording needs all of these: without STRIDE and CROPPING the player drops every frame in silence.
  void notifyAllProperties() override {
    raise(ONI_STREAM_PROPERTY_VIDEO_MODE, mode_);
    raise(ONI_STREAM_PROPERTY_STRIDE, stride());
    raise(ONI_STREAM_PROPERTY_CROPPING, whole());
    raise(ONI_STREAM_PROPERTY_HORIZONTAL_FOV, fov_.horizontal);
    raise(ONI_STREAM_PROPERTY_VERTICAL_FOV, fov_.vertical);
    raise(ONI_STREAM_PROPERTY_MIRRORING, mirrored());
    raise(ONI_STREAM_PROPERTY_MAX_VALUE, max_value());
    raise(ONI_STREAM_PROPERTY_MIN_VALUE, 0);
  }

  // Hands one image to the runtime, if the stream is on; the pixels are copied.
  void deliver(const std::uint16_t* pixels, std::uint64_t timestamp_us, int index) {
    std::lock_guard<std::timed_mutex> delivering(delivery_);
    if (!on_) return;
    OniFrame* frame = getServices().acquireFrame();
    if (frame == nullptr) return;
    const int bytes = stride() * mode_.resolutionY;
    if (frame->dataSize >= bytes) {
      write(static_cast<std::uint16_t*>(frame->data), pixels);
      frame->dataSize = bytes;
      frame->sensorType = sensor_;
      frame->timestamp = timestamp_us;
      frame->frameIndex = index;
      frame->width = mode_.resolutionX;
      frame->height = mode_.resolutionY;
      frame->videoMode = mode_;
      frame->croppingEnabled = FALSE;
      frame->cropOriginX = frame->cropOriginY = 0;
      frame->stride = stride();
      raiseNewFrame(frame);
    }
    getServices().releaseFrame(frame);
  }

 protected:
  virtual OniStatus mirror(bool wanted) = 0;
  virtual OniBool mirrored() const = 0;

 private:
  bool in_tenths() const { return mode_.pixelFormat == ONI_PIXEL_FORMAT_DEPTH_100_UM; }
  int max_value() const { return in_tenths() ? 65535 : max_value_; }
  int stride() const { return mode_.resolutionX * static_cast<int>(sizeof(std::uint16_t)); }
  OniCropping whole() const { return OniCropping{FALSE, 0, 0, mode_.resolutionX, mode_.resolutionY}; }

  template <typename Value>
  void raise(int id, Value value) {
    raisePropertyChanged(id, &value, sizeof value);
  }

  // Sources count millimetres. In tenths of them 16 bits end at 6.5535 m; beyond there is no value.
  void write(std::uint16_t* to, const std::uint16_t* from) const {
    const int rows = mode_.resolutionY, columns = mode_.resolutionX;
    const bool tenths = in_tenths();
    const bool turned = mirrored() != FALSE;
    if (!tenths && !turned) {
      std::memcpy(to, from, static_cast<std::size_t>(rows) * columns * sizeof *to);
      return;
    }
    for (int row = 0; row < rows; ++row, to += columns, from += columns) {
      for (int column = 0; column < columns; ++column) {
        const unsigned value = from[turned ? columns - 1 - column : column] * (tenths ? 10u : 1u);
        to[column] = static_cast<std::uint16_t>(value > 65535u ? 0u : value);
      }
    }
  }

  const OniSensorType sensor_;
  const std::vector<OniVideoMode> modes_;
  OniVideoMode mode_;
  const FieldOfView fov_;
  const int max_value_;  // one above what can come: the recorder's codec garbles anything else
  std::atomic<bool> on_{false};
  std::timed_mutex delivery_;
};

}  // namespace surfclass
