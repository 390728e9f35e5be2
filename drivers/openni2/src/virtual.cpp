// OpenNI2 driver plug-in "virtual": a depth camera whose frames another process writes into a shared file.
//
// The file is laid out in drivers/openni2/virtual_file.py; the URI is "virtual://" and its path. The writer
// holds a lock on it for as long as it lives, so that its death is seen without its help.
//
// Watching goes on while a device of this plug-in is open, and only then: the runtime calls shutdown() with
// the very lock held that its hot-plug callbacks take, so that no thread may be left by then.

#include "frame_stream.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstddef>
#include <cstdlib>
#include <map>
#include <memory>
#include <string>
#include <thread>

namespace {

using surfclass::FieldOfView;
using surfclass::FrameStream;
using std::chrono::milliseconds;
using std::chrono::steady_clock;

const char SCHEME[] = "virtual://";
const char PATHS_VARIABLE[] = "SURFCLASS_VIRTUAL_KINECT";  // a file that is announced at the start
const milliseconds FRAME_POLL(1);
const milliseconds LIFE_POLL(100);
const std::uint32_t VERSION = 1;
const std::uint32_t MAX_SIDE = 8192;
const std::uint32_t KEEPS_MIRRORING = 1, KEEPS_REGISTRATION = 2;

struct Header {
  char magic[8];
  std::uint32_t version, width, height, fps;
  float horizontal_fov, vertical_fov;
  std::uint32_t plugged;   // 0: not; else the how-manieth time, so that no unplugging is too short to be seen
  std::uint32_t stubborn;  // which settings do not take: KEEPS_…
  std::uint32_t registration;  // written here: the mode that was last asked for
  std::uint32_t frame_index;
  std::uint64_t sequence;  // a seqlock: odd while a frame is being written
  std::uint64_t timestamp_us;
  char serial[32];
  char reserved[32];
};
static_assert(sizeof(Header) == 128 && offsetof(Header, sequence) == 48, "as in virtual_file.py");
static_assert(std::atomic<std::uint64_t>::is_always_lock_free, "shared between processes");

template <typename Value>
Value load(const Value& value, std::memory_order order = std::memory_order_acquire) {
  return reinterpret_cast<const std::atomic<Value>&>(value).load(order);
}

// The file, mapped. One is opened anew for each device, so that a device never sees another writer's frames.
class SharedFile {
 public:
  static std::shared_ptr<SharedFile> open(const std::string& path) {
    const int descriptor = ::open(path.c_str(), O_RDWR | O_CLOEXEC);
    if (descriptor < 0) return nullptr;
    std::shared_ptr<SharedFile> file(new SharedFile(path, descriptor));
    return file->map() ? file : nullptr;
  }

  ~SharedFile() {
    if (header_ != nullptr) ::munmap(header_, bytes_);
    ::close(descriptor_);
  }

  Header& header() { return *header_; }
  std::size_t pixels() const { return pixels_; }
  const std::uint16_t* depth() const { return reinterpret_cast<const std::uint16_t*>(header_ + 1); }
  const std::uint16_t* infrared() const { return depth() + pixels_; }

  // Whether a living writer has it plugged in, and it is still the file at its path.
  bool alive() const {
    struct stat here;
    if (::stat(path_.c_str(), &here) != 0 || here.st_ino != inode_ || here.st_dev != device_) return false;
    struct flock lock = {};
    lock.l_type = F_RDLCK;
    lock.l_whence = SEEK_SET;
    if (::fcntl(descriptor_, F_OFD_GETLK, &lock) != 0 || lock.l_type == F_UNLCK) return false;
    return connected();
  }

  // Whether it is still plugged in as it was when this was opened.
  bool connected() const { return plugged_ != 0 && load(header_->plugged) == plugged_; }

 private:
  SharedFile(const std::string& path, int descriptor) : path_(path), descriptor_(descriptor) {}

  bool map() {
    struct stat status;
    if (::fstat(descriptor_, &status) != 0 || status.st_size < static_cast<off_t>(sizeof(Header))) return false;
    bytes_ = static_cast<std::size_t>(status.st_size);
    inode_ = status.st_ino;
    device_ = status.st_dev;
    void* at = ::mmap(nullptr, bytes_, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor_, 0);
    if (at == MAP_FAILED) return false;
    header_ = static_cast<Header*>(at);
    if (std::memcmp(header_->magic, "SCKINECT", sizeof header_->magic) != 0) return false;
    if (header_->version != VERSION || header_->width < 1 || header_->width > MAX_SIDE) return false;
    if (header_->height < 1 || header_->height > MAX_SIDE || header_->fps < 1) return false;
    plugged_ = load(header_->plugged);
    pixels_ = static_cast<std::size_t>(header_->width) * header_->height;
    return bytes_ >= sizeof(Header) + 2 * pixels_ * sizeof(std::uint16_t);
  }

  const std::string path_;
  const int descriptor_;
  Header* header_ = nullptr;
  std::size_t bytes_ = 0, pixels_ = 0;
  std::uint32_t plugged_ = 0;
  ino_t inode_ = 0;
  dev_t device_ = 0;
};

class VirtualStream : public FrameStream {
 public:
  VirtualStream(std::shared_ptr<SharedFile> file, OniSensorType sensor, std::vector<OniVideoMode> modes,
                FieldOfView fov)
      : FrameStream(sensor, std::move(modes), fov, 65535), file_(std::move(file)) {}

 protected:
  OniStatus mirror(bool wanted) override {
    if ((load(file_->header().stubborn) & KEEPS_MIRRORING) == 0) mirrored_ = wanted;
    return ONI_STATUS_OK;
  }

  OniBool mirrored() const override { return mirrored_ ? TRUE : FALSE; }

 private:
  const std::shared_ptr<SharedFile> file_;
  std::atomic<bool> mirrored_{true};  // as the hardware comes
};

class Listener {
 public:
  virtual ~Listener() = default;
  virtual void came(const std::string& uri) = 0;
  virtual void went(const std::string& uri) = 0;
};

class VirtualDevice : public oni::driver::DeviceBase {
 public:
  VirtualDevice(const std::string& uri, std::shared_ptr<SharedFile> file, Listener& listener)
      : uri_(uri), file_(std::move(file)), listener_(listener), last_(load(file_->header().sequence)) {
    const Header& header = file_->header();
    const int width = static_cast<int>(header.width), height = static_cast<int>(header.height);
    const int fps = static_cast<int>(header.fps);
    depth_modes_ = {{ONI_PIXEL_FORMAT_DEPTH_1_MM, width, height, fps},
                    {ONI_PIXEL_FORMAT_DEPTH_100_UM, width, height, fps}};
    infrared_modes_ = {{ONI_PIXEL_FORMAT_GRAY16, width, height, fps}};
    sensors_[0] = {ONI_SENSOR_DEPTH, 2, depth_modes_.data()};
    sensors_[1] = {ONI_SENSOR_IR, 1, infrared_modes_.data()};
    depth_.resize(file_->pixels());
    infrared_.resize(file_->pixels());
    thread_ = std::thread([this] { run(); });
  }

  ~VirtualDevice() override {
    running_ = false;
    thread_.join();
  }

  OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
    *sensors = sensors_;
    *count = 2;
    return ONI_STATUS_OK;
  }

  oni::driver::StreamBase* createStream(OniSensorType sensor) override {
    const FieldOfView fov = {file_->header().horizontal_fov, file_->header().vertical_fov};
    std::lock_guard<std::mutex> locked(streams_);
    std::shared_ptr<VirtualStream>* place = place_of(sensor);
    if (place == nullptr || *place) return nullptr;
    *place = std::make_shared<VirtualStream>(
        file_, sensor, sensor == ONI_SENSOR_DEPTH ? depth_modes_ : infrared_modes_, fov);
    return place->get();
  }

  void destroyStream(oni::driver::StreamBase* stream) override {
    std::shared_ptr<VirtualStream> last;  // dies after the lock is let go, or with the frame under way
    std::lock_guard<std::mutex> locked(streams_);
    for (std::shared_ptr<VirtualStream>* place : {&depth_stream_, &infrared_stream_}) {
      if (place->get() == stream) last.swap(*place);
    }
  }

  OniBool isPropertySupported(int id) override {
    return id == ONI_DEVICE_PROPERTY_SERIAL_NUMBER || id == ONI_DEVICE_PROPERTY_FIRMWARE_VERSION ||
           id == ONI_DEVICE_PROPERTY_DRIVER_VERSION || id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION;
  }

  OniStatus getProperty(int id, void* data, int* size) override {
    switch (id) {
      case ONI_DEVICE_PROPERTY_SERIAL_NUMBER: {
        const char* serial = file_->header().serial;
        return surfclass::give_text(std::string(serial, strnlen(serial, 32)).c_str(), data, size);
      }
      case ONI_DEVICE_PROPERTY_FIRMWARE_VERSION: return surfclass::give_text("1.0", data, size);
      case ONI_DEVICE_PROPERTY_DRIVER_VERSION: return surfclass::give(OniVersion{1, 0, 0, 0}, data, size);
      case ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION: return surfclass::give(registration_.load(), data, size);
      default: return ONI_STATUS_NOT_SUPPORTED;
    }
  }

  OniStatus setProperty(int id, const void* data, int size) override {
    int wanted;
    if (id != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION) return ONI_STATUS_NOT_SUPPORTED;
    if (!surfclass::take(wanted, data, size)) return ONI_STATUS_BAD_PARAMETER;
    file_->header().registration = static_cast<std::uint32_t>(wanted);
    if ((load(file_->header().stubborn) & KEEPS_REGISTRATION) == 0) registration_ = wanted;
    return ONI_STATUS_OK;
  }

  OniBool isImageRegistrationModeSupported(OniImageRegistrationMode) override { return TRUE; }

 private:
  std::shared_ptr<VirtualStream>* place_of(OniSensorType sensor) {
    if (sensor == ONI_SENSOR_DEPTH) return &depth_stream_;
    return sensor == ONI_SENSOR_IR ? &infrared_stream_ : nullptr;
  }

  void run() {
    bool lost = false;  // for good: the same camera plugged in again is another device to the runtime
    steady_clock::time_point look = steady_clock::now();
    while (running_) {
      if (steady_clock::now() >= look) {
        look = steady_clock::now() + LIFE_POLL;
        if (!lost && !file_->alive()) {
          lost = true;
          listener_.went(uri_);
        } else if (lost) {
          listener_.came(uri_);
        }
      }
      if (!lost) deliver();
      std::this_thread::sleep_for(lost ? LIFE_POLL / 4 : FRAME_POLL);
    }
  }

  void deliver() {
    Header& header = file_->header();
    const std::uint64_t before = load(header.sequence);
    if (before == last_ || before % 2 != 0 || !file_->connected()) return;
    const std::size_t bytes = file_->pixels() * sizeof(std::uint16_t);
    std::memcpy(depth_.data(), file_->depth(), bytes);
    std::memcpy(infrared_.data(), file_->infrared(), bytes);
    const std::uint64_t timestamp_us = header.timestamp_us;
    const int index = static_cast<int>(header.frame_index);
    std::atomic_thread_fence(std::memory_order_acquire);
    if (load(header.sequence, std::memory_order_relaxed) != before) return;  // torn: the writer came in
    last_ = before;
    std::shared_ptr<VirtualStream> depth, infrared;
    {
      std::lock_guard<std::mutex> locked(streams_);
      depth = depth_stream_;
      infrared = infrared_stream_;
    }
    if (depth) depth->deliver(depth_.data(), timestamp_us, index);
    if (infrared) infrared->deliver(infrared_.data(), timestamp_us, index);
  }

  const std::string uri_;
  const std::shared_ptr<SharedFile> file_;
  Listener& listener_;
  std::uint64_t last_;
  std::vector<OniVideoMode> depth_modes_, infrared_modes_;
  OniSensorInfo sensors_[2];
  std::vector<std::uint16_t> depth_, infrared_;
  std::mutex streams_;
  std::shared_ptr<VirtualStream> depth_stream_, infrared_stream_;
  std::atomic<int> registration_{ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR};  // not as our driver wants it
  std::atomic<bool> running_{true};
  std::thread thread_;
};

class VirtualDriver : public oni::driver::DriverBase, private Listener {
 public:
  explicit VirtualDriver(OniDriverServices* services) : DriverBase(services) {}

  OniStatus initialize(oni::driver::DeviceConnectedCallback connected,
                       oni::driver::DeviceDisconnectedCallback disconnected,
                       oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
    const OniStatus status = DriverBase::initialize(connected, disconnected, changed, cookie);
    if (const char* path = std::getenv(PATHS_VARIABLE)) came(std::string(SCHEME) + path);
    return status;
  }

  OniStatus tryDevice(const char* uri) override {
    came(uri);
    std::lock_guard<std::mutex> locked(known_);
    return listed_[uri] ? ONI_STATUS_OK : ONI_STATUS_ERROR;
  }

  oni::driver::DeviceBase* deviceOpen(const char* uri, const char*) override {
    const std::shared_ptr<SharedFile> file = find(uri);
    if (file) return new VirtualDevice(uri, file, *this);
    getServices().errorLoggerAppend("%s: no living writer", uri);
    return nullptr;
  }

  void deviceClose(oni::driver::DeviceBase* device) override { delete device; }

  void shutdown() override {}

 private:
  static std::shared_ptr<SharedFile> find(const std::string& uri) {
    if (uri.rfind(SCHEME, 0) != 0) return nullptr;
    const std::shared_ptr<SharedFile> file = SharedFile::open(uri.substr(sizeof SCHEME - 1));
    return file && file->alive() ? file : nullptr;
  }

  void came(const std::string& uri) override {
    if (uri.size() < ONI_MAX_STR && find(uri) && change(uri, true)) {
      const OniDeviceInfo info = describe(uri);
      deviceConnected(&info);
    }
  }

  void went(const std::string& uri) override {
    if (change(uri, false)) {
      const OniDeviceInfo info = describe(uri);
      deviceDisconnected(&info);
    }
  }

  // Whether this is news. The lock must be let go before the runtime is told: it may hold its own lock
  // and ask us.
  bool change(const std::string& uri, bool listed) {
    std::lock_guard<std::mutex> locked(known_);
    bool& was = listed_[uri];
    const bool news = was != listed;
    was = listed;
    return news;
  }

  static OniDeviceInfo describe(const std::string& uri) {
    OniDeviceInfo info = {};
    std::strncpy(info.uri, uri.c_str(), sizeof info.uri - 1);
    std::strncpy(info.vendor, "surfclass", sizeof info.vendor - 1);
    std::strncpy(info.name, "Virtual Kinect", sizeof info.name - 1);
    return info;
  }

  std::mutex known_;
  std::map<std::string, bool> listed_;
};

}  // namespace

ONI_EXPORT_DRIVER(VirtualDriver)
