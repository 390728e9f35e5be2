// OpenNI2 driver plug-in "kinect1": Kinect for Xbox 360 and for Windows (v1) through libfreenect.
//
// Depth in millimetres by the device's own tables (in tenths where asked: times ten), and the IR image of the same camera (10 bit); no
// colour, because IR and colour are two formats of one USB stream. Time stamps are the device's, in µs
// (its clock runs at 60 MHz and wraps at 32 bits). Mirroring and registration are off and stay off.
//
// IR comes as 640 × 488 pixels. The middle 480 rows are kept: TO BE CONFIRMED ON HARDWARE with a
// calibration board, as is the shift of a few pixels between IR and depth (the correlation window).
//
// While a device is open one thread makes every call of libfreenect, which locks nothing. It runs then and
// only then: the runtime calls shutdown() with the lock held that its hot-plug callbacks take. It writes
// no error messages: the runtime keeps those by thread, and must not meet one that has ended.

#include "frame_stream.hpp"

#include <libfreenect.h>
#include <libfreenect_registration.h>

#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <thread>

namespace {

using surfclass::FieldOfView;
using surfclass::FrameStream;
using std::chrono::milliseconds;
using std::chrono::steady_clock;

const char SCHEME[] = "kinect1://";  // and the camera's serial number
const int WIDTH = 640, HEIGHT = 480, FPS = 30;
const int INFRARED_HEIGHT = 488, INFRARED_FIRST_ROW = (INFRARED_HEIGHT - HEIGHT) / 2;
const int DEPTH_MAX = FREENECT_DEPTH_MM_MAX_VALUE + 1, INFRARED_MAX = 1024;
const std::int64_t TICKS_PER_US = 60;
const milliseconds EVENTS(20), LIST_POLL(500);
const std::chrono::seconds CALL_TIMEOUT(5);
const int DEVICE_DEAD = -1;  // of freenect_process_events_timeout; an interrupted wait is another number

const std::vector<OniVideoMode> DEPTH_MODES = {{ONI_PIXEL_FORMAT_DEPTH_1_MM, WIDTH, HEIGHT, FPS},
                                               {ONI_PIXEL_FORMAT_DEPTH_100_UM, WIDTH, HEIGHT, FPS}};
const std::vector<OniVideoMode> INFRARED_MODES = {{ONI_PIXEL_FORMAT_GRAY16, WIDTH, HEIGHT, FPS}};

// Both streams' stamps on one scale that does not wrap. Which wrap a stamp belongs to, the host's clock
// tells: a pause may be longer than the 72 s of one.
class TickCounter {
 public:
  std::uint64_t microseconds(std::uint32_t ticks) {
    const steady_clock::time_point now = steady_clock::now();
    if (!began_) {
      began_ = true;
      last_ = ticks;
    } else {
      const auto passed = std::chrono::duration_cast<std::chrono::microseconds>(now - when_).count();
      const std::int64_t expected = last_ + passed * TICKS_PER_US;
      last_ = expected + static_cast<std::int32_t>(ticks - static_cast<std::uint32_t>(expected));
    }
    when_ = now;
    return static_cast<std::uint64_t>(std::max<std::int64_t>(0, last_)) / TICKS_PER_US;
  }

 private:
  bool began_ = false;
  std::int64_t last_ = 0;
  steady_clock::time_point when_;
};

class KinectStream : public FrameStream {
 public:
  // Switches the device's stream; false where it refuses.
  using Switch = std::function<bool(bool on)>;

  KinectStream(OniSensorType sensor, FieldOfView fov, Switch change)
      : FrameStream(sensor, sensor == ONI_SENSOR_DEPTH ? DEPTH_MODES : INFRARED_MODES, fov,
                    sensor == ONI_SENSOR_DEPTH ? DEPTH_MAX : INFRARED_MAX),
        change_(std::move(change)) {}

  OniStatus start() override {
    FrameStream::start();
    if (change_(true)) return ONI_STATUS_OK;
    FrameStream::stop();
    return ONI_STATUS_ERROR;
  }

  void stop() override {
    FrameStream::stop();
    change_(false);
  }

 protected:
  OniStatus mirror(bool wanted) override { return wanted ? ONI_STATUS_NOT_SUPPORTED : ONI_STATUS_OK; }
  OniBool mirrored() const override { return FALSE; }

 private:
  const Switch change_;
};

// The thread that owns libfreenect: runs what it is asked to between handling USB events.
class Worker {
 public:
  Worker(std::function<void()> always) : always_(std::move(always)), thread_([this] { run(); }) {}

  ~Worker() {
    running_ = false;
    thread_.join();
  }

  // Runs `task` on the thread and returns what it returned; false where the thread did not get to it.
  bool call(std::function<bool()> task) {
    auto job = std::make_shared<Job>();
    job->task = std::move(task);
    std::unique_lock<std::mutex> locked(mutex_);
    jobs_.push_back(job);
    if (!done_.wait_for(locked, CALL_TIMEOUT, [&] { return job->done; })) job->task = nullptr;
    return job->result;
  }

 private:
  struct Job {
    std::function<bool()> task;
    bool done = false, result = false;
  };

  void run() {
    while (running_) {
      std::shared_ptr<Job> job;
      std::function<bool()> task;
      {
        std::lock_guard<std::mutex> locked(mutex_);
        if (!jobs_.empty()) {
          job = jobs_.front();
          jobs_.pop_front();
          task.swap(job->task);  // empty where the caller has given up
        }
      }
      if (!job) {
        always_();
        continue;
      }
      const bool result = task && task();
      std::lock_guard<std::mutex> locked(mutex_);
      job->result = result;
      job->done = true;
      done_.notify_all();
    }
  }

  const std::function<void()> always_;
  std::mutex mutex_;
  std::condition_variable done_;
  std::deque<std::shared_ptr<Job>> jobs_;
  std::atomic<bool> running_{true};
  std::thread thread_;
};

class KinectDevice : public oni::driver::DeviceBase {
 public:
  KinectDevice(const std::string& uri, freenect_device* camera, Worker& worker)
      : uri(uri), camera_(camera), worker_(worker), fov_(field_of_view(camera)) {
    freenect_set_user(camera, this);
    freenect_set_depth_callback(camera, [](freenect_device* from, void* pixels, std::uint32_t ticks) {
      static_cast<KinectDevice*>(freenect_get_user(from))->deliver(ONI_SENSOR_DEPTH, pixels, ticks);
    });
    freenect_set_video_callback(camera, [](freenect_device* from, void* pixels, std::uint32_t ticks) {
      static_cast<KinectDevice*>(freenect_get_user(from))->deliver(ONI_SENSOR_IR, pixels, ticks);
    });
  }

  // On the worker's thread, as everything that touches libfreenect.
  void release() { freenect_close_device(camera_); }

  OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
    *sensors = sensors_;
    *count = 2;
    return ONI_STATUS_OK;
  }

  oni::driver::StreamBase* createStream(OniSensorType sensor) override {
    std::lock_guard<std::mutex> locked(mutex_);
    if ((sensor != ONI_SENSOR_DEPTH && sensor != ONI_SENSOR_IR) || streams_[sensor]) return nullptr;
    streams_[sensor] = std::make_shared<KinectStream>(sensor, fov_, [this, sensor](bool on) {
      return worker_.call([this, sensor, on] { return lost ? !on : change(sensor, on); });
    });
    return streams_[sensor].get();
  }

  void destroyStream(oni::driver::StreamBase* stream) override {
    std::shared_ptr<KinectStream> last;  // dies after the lock is let go, or with the frame under way
    std::lock_guard<std::mutex> locked(mutex_);
    for (auto& place : streams_) {
      if (place.second.get() == stream) last.swap(place.second);
    }
  }

  OniBool isPropertySupported(int id) override {
    return id == ONI_DEVICE_PROPERTY_SERIAL_NUMBER || id == ONI_DEVICE_PROPERTY_DRIVER_VERSION ||
           id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION;
  }

  OniStatus getProperty(int id, void* data, int* size) override {
    switch (id) {
      case ONI_DEVICE_PROPERTY_SERIAL_NUMBER:
        return surfclass::give_text(uri.c_str() + sizeof SCHEME - 1, data, size);
      case ONI_DEVICE_PROPERTY_DRIVER_VERSION: return surfclass::give(OniVersion{1, 0, 0, 0}, data, size);
      case ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION:
        return surfclass::give(static_cast<int>(ONI_IMAGE_REGISTRATION_OFF), data, size);
      default: return ONI_STATUS_NOT_SUPPORTED;
    }
  }

  OniStatus setProperty(int id, const void* data, int size) override {
    int wanted;
    if (id != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION) return ONI_STATUS_NOT_SUPPORTED;
    if (!surfclass::take(wanted, data, size)) return ONI_STATUS_BAD_PARAMETER;
    return wanted == ONI_IMAGE_REGISTRATION_OFF ? ONI_STATUS_OK : ONI_STATUS_NOT_SUPPORTED;
  }

  const std::string uri;
  bool lost = false;  // for good; on the worker's thread

 private:
  // The focal length in pixels of 1280 columns is that of the zero plane; the device tells both.
  static FieldOfView field_of_view(freenect_device* camera) {
    freenect_registration told = freenect_copy_registration(camera);
    const float distance = told.zero_plane_info.reference_distance;
    const float pixel = 2 * told.zero_plane_info.reference_pixel_size;
    freenect_destroy_registration(&told);
    if (!(distance > 0) || !(pixel > 0)) return {0, 0};  // it told nothing
    return {2 * std::atan(WIDTH / 2 * pixel / distance), 2 * std::atan(HEIGHT / 2 * pixel / distance)};
  }

  bool change(OniSensorType sensor, bool on) {
    if (sensor == ONI_SENSOR_DEPTH) {
      if (!on) return freenect_stop_depth(camera_) == 0;
      const freenect_frame_mode mode = freenect_find_depth_mode(FREENECT_RESOLUTION_MEDIUM, FREENECT_DEPTH_MM);
      return mode.is_valid && freenect_set_depth_mode(camera_, mode) == 0 &&
             freenect_set_flag(camera_, FREENECT_MIRROR_DEPTH, FREENECT_OFF) == 0 &&
             freenect_start_depth(camera_) == 0;
    }
    if (!on) return freenect_stop_video(camera_) == 0;
    const freenect_frame_mode mode =
        freenect_find_video_mode(FREENECT_RESOLUTION_MEDIUM, FREENECT_VIDEO_IR_10BIT);
    return mode.is_valid && freenect_set_video_mode(camera_, mode) == 0 &&
           freenect_set_flag(camera_, FREENECT_MIRROR_VIDEO, FREENECT_OFF) == 0 &&
           freenect_start_video(camera_) == 0;
  }

  void deliver(OniSensorType sensor, const void* pixels, std::uint32_t ticks) {
    const std::uint64_t timestamp_us = clock_.microseconds(ticks);
    std::shared_ptr<KinectStream> stream;
    {
      std::lock_guard<std::mutex> locked(mutex_);
      stream = streams_[sensor];
    }
    if (!stream) return;
    const std::uint16_t* first = static_cast<const std::uint16_t*>(pixels);
    if (sensor == ONI_SENSOR_IR) first += INFRARED_FIRST_ROW * WIDTH;
    stream->deliver(first, timestamp_us, ++index_[sensor]);
  }

  freenect_device* const camera_;
  Worker& worker_;
  const FieldOfView fov_;
  std::vector<OniVideoMode> depth_modes_ = DEPTH_MODES, infrared_modes_ = INFRARED_MODES;
  OniSensorInfo sensors_[2] = {{ONI_SENSOR_DEPTH, 2, depth_modes_.data()},
                               {ONI_SENSOR_IR, 1, infrared_modes_.data()}};
  std::mutex mutex_;
  std::map<OniSensorType, std::shared_ptr<KinectStream>> streams_;
  std::map<OniSensorType, int> index_;
  TickCounter clock_;
};

class KinectDriver : public oni::driver::DriverBase {
 public:
  explicit KinectDriver(OniDriverServices* services) : DriverBase(services) {}

  OniStatus initialize(oni::driver::DeviceConnectedCallback connected,
                       oni::driver::DeviceDisconnectedCallback disconnected,
                       oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
    const OniStatus status = DriverBase::initialize(connected, disconnected, changed, cookie);
    announce(serials());
    return status;
  }

  OniStatus tryDevice(const char* uri) override {
    if (std::string(uri).rfind(SCHEME, 0) != 0 || worker_) return ONI_STATUS_ERROR;
    announce(serials());
    return listed_.count(uri) ? ONI_STATUS_OK : ONI_STATUS_ERROR;
  }

  oni::driver::DeviceBase* deviceOpen(const char* uri, const char*) override {
    if (!ready()) return nullptr;
    if (!worker_) worker_ = std::make_unique<Worker>([this] { handle_events(); });
    const auto device = std::make_shared<KinectDevice*>(nullptr);  // outlives a caller who gave up
    const std::string wanted = uri;
    if (worker_->call([this, device, wanted] { return (*device = open(wanted)) != nullptr; })) return *device;
    if (open_.empty()) worker_.reset();
    getServices().errorLoggerAppend("%s: cannot be opened: unplugged, in use, or no permission", uri);
    return nullptr;
  }

  void deviceClose(oni::driver::DeviceBase* base) override {
    KinectDevice* device = static_cast<KinectDevice*>(base);
    const bool released = worker_->call([this, device] {
      open_.erase(device);
      device->release();
      return true;
    });
    if (!released) return;  // the thread hangs in libfreenect and may still touch it: better leaked
    delete device;
    if (open_.empty()) worker_.reset();
  }

  void shutdown() override {
    worker_.reset();
    if (context_ != nullptr) freenect_shutdown(context_);
    context_ = nullptr;
  }

 private:
  bool ready() {
    if (context_ != nullptr) return true;
    if (freenect_init(&context_, nullptr) < 0) {
      context_ = nullptr;
      getServices().errorLoggerAppend("kinect1: no USB here (libfreenect cannot start)");
      return false;
    }
    freenect_set_log_level(context_, FREENECT_LOG_FATAL);
    freenect_select_subdevices(context_, FREENECT_DEVICE_CAMERA);
    return true;
  }

  std::set<std::string> serials() {
    std::set<std::string> found;
    if (!ready()) return found;
    freenect_device_attributes* first = nullptr;
    const int listed = freenect_list_device_attributes(context_, &first);
    for (const freenect_device_attributes* at = first; listed > 0 && at != nullptr; at = at->next) {
      if (at->camera_serial != nullptr) found.insert(SCHEME + std::string(at->camera_serial));
    }
    if (listed > 0) freenect_free_device_attributes(first);
    return found;
  }

  KinectDevice* open(const std::string& uri) {
    freenect_device* camera = nullptr;
    if (freenect_open_device_by_camera_serial(context_, &camera, uri.c_str() + sizeof SCHEME - 1) < 0) {
      return nullptr;
    }
    KinectDevice* device = new KinectDevice(uri, camera, *worker_);
    open_.insert(device);
    count_ = freenect_num_devices(context_);
    return device;
  }

  void handle_events() {
    const bool listening = std::any_of(open_.begin(), open_.end(), [](KinectDevice* one) { return !one->lost; });
    bool dead = false;
    if (listening) {
      timeval timeout = {0, static_cast<suseconds_t>(1000 * EVENTS.count())};
      dead = freenect_process_events_timeout(context_, &timeout) == DEVICE_DEAD;
    } else {
      std::this_thread::sleep_for(EVENTS);
    }
    const steady_clock::time_point now = steady_clock::now();
    if (!dead && now < look_) return;
    look_ = now + LIST_POLL;
    const int count = freenect_num_devices(context_);
    if (!dead && count == count_) return;
    count_ = count;
    const std::set<std::string> found = serials();
    std::set<std::string> remaining = found;
    for (KinectDevice* device : open_) {
      // libfreenect does not tell which of several died; one that is plugged in again is another, too.
      if (dead || !found.count(device->uri)) device->lost = true;
      if (dead) remaining.erase(device->uri);
    }
    announce(remaining);
    announce(found);
  }

  // Tells the runtime what came and what went; on the worker's thread, or while there is none.
  void announce(const std::set<std::string>& now) {
    const std::set<std::string> before = listed_;
    listed_ = now;
    for (const std::string& uri : before) {
      if (now.count(uri)) continue;
      const OniDeviceInfo info = describe(uri);
      deviceDisconnected(&info);
    }
    for (const std::string& uri : now) {
      if (before.count(uri)) continue;
      const OniDeviceInfo info = describe(uri);
      deviceConnected(&info);
    }
  }

  static OniDeviceInfo describe(const std::string& uri) {
    OniDeviceInfo info = {};
    std::strncpy(info.uri, uri.c_str(), sizeof info.uri - 1);
    std::strncpy(info.vendor, "Microsoft", sizeof info.vendor - 1);
    std::strncpy(info.name, "Kinect v1", sizeof info.name - 1);
    info.usbVendorId = 0x045e;
    info.usbProductId = 0x02ae;
    return info;
  }

  freenect_context* context_ = nullptr;
  std::set<std::string> listed_;
  std::set<KinectDevice*> open_;  // on the worker's thread
  int count_ = 0;
  steady_clock::time_point look_;
  std::unique_ptr<Worker> worker_;
};

}  // namespace

ONI_EXPORT_DRIVER(KinectDriver)
