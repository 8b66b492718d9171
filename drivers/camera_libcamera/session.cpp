/* libcamera, versions 0.0.3 and 0.3 (the calls below are those that both compile): finds a camera, maps its buffers,
 * and hands filled ones over from libcamera's own thread. */
#include "camera_libcamera/libcamera.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <deque>
#include <memory>
#include <mutex>
#include <new>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <fcntl.h>
#include <linux/dma-buf.h>
#include <sys/ioctl.h>
#include <sys/mman.h>

#include <libcamera/libcamera.h>

namespace
{

using namespace libcamera;

const int GAIN_UNIT = 64; /* gains in a session count in 64ths */

/* libcamera's formats (Linux's DRM codes, which name the bytes of a word from the top) by our names. */
struct FormatName {
    PixelFormat theirs;
    const char *ours;
};

const std::array<FormatName, 11> FORMATS{{{formats::R8, "GREY"},
                                          {formats::NV12, "NV12"},
                                          {formats::NV21, "NV21"},
                                          {formats::YUV420, "YU12"},
                                          {formats::R10, "Y10"},
                                          {formats::R12, "Y12"},
                                          {formats::YUYV, "YUYV"},
                                          {formats::UYVY, "UYVY"},
                                          {formats::BGR888, "RGB3"},
                                          {formats::RGB888, "BGR3"},
                                          {formats::MJPEG, "MJPG"}}};

uint64_t now_ns()
{
    timespec t{};
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return static_cast<uint64_t>(t.tv_sec) * 1000000000u + static_cast<uint64_t>(t.tv_nsec);
}

enum class State { idle, queued, filled, held };

/* A buffer with the request that it travels in, and its first plane in our memory. */
struct Buffer {
    std::unique_ptr<Request> request;
    FrameBuffer *frame = nullptr;
    uint8_t *memory = nullptr; /* of the mapping, from the file's first byte on */
    size_t size = 0;
    uint32_t offset = 0; /* of the plane */
    int fd = -1;
    State state = State::idle;
};

struct Kept {
    uint8_t *pixels, *memory;
    size_t size;
};

class Session
{
public:
    pf_status open(const pf_session_wish &wish, pf_session_info &info, pf_failure *failure);
    pf_status start(pf_failure *failure);
    void stop();
    pf_status take(uint32_t timeout_ms, pf_session_frame &frame, pf_failure *failure);
    void give(uint32_t i);
    void set(bool isAutomatic, int64_t time, int64_t gain);
    void keep(uint32_t i);
    void drop(uint8_t *pixels);
    void close();

private:
    pf_status begin(pf_failure *failure);
    std::shared_ptr<Camera> find(const std::string &device);
    pf_status acquire(const std::string &device, pf_failure *failure);
    pf_status configure(const pf_session_wish &wish, pf_session_info &info, pf_failure *failure);
    pf_status mapBuffers(pf_failure *failure);
    void describeControls(const pf_session_wish &wish, pf_session_info &info);
    void queueIdle();
    void onCompleted(Request *request);
    void onDisconnected();
    template <typename T> bool has(const Control<T> &control) const
    {
        return camera_->controls().find(control.id()) != camera_->controls().end();
    }

    /* Only while a camera is open: a manager keeps what it learnt of a device that has gone, and follows a dangling
     * pointer when the next of the same number announces its video node before its media node (seen in 0.0.3). */
    std::unique_ptr<CameraManager> manager_;
    std::shared_ptr<Camera> camera_;
    bool isRunning_ = false, hasTime_ = false, hasGain_ = false;
    std::string id_;
    std::unique_ptr<CameraConfiguration> configuration_;
    Stream *stream_ = nullptr;
    std::unique_ptr<FrameBufferAllocator> allocator_;
    std::vector<Buffer> buffers_;
    std::vector<Kept> kept_;
    ControlList first_, next_; /* for the start; for the next request */

    std::mutex mutex_; /* guards what follows and the buffers' states */
    std::condition_variable change_;
    std::deque<uint32_t> filled_;
    bool isGone_ = false;
};

pf_status Session::begin(pf_failure *failure)
{
    manager_ = std::make_unique<CameraManager>();
    int error = manager_->start();
    if (error != 0)
        return pf_fail(failure, PF_ERR_IO, "libcamera %s: does not start: %s", CameraManager::version().c_str(),
                       std::strerror(-error));
    /* Once is enough of what it says of itself: without a camera it is started four times a second. */
    if (std::getenv("LIBCAMERA_LOG_LEVELS") == nullptr)
        (void)logSetLevel("Camera", "WARN");
    return PF_OK;
}

std::shared_ptr<Camera> Session::find(const std::string &device)
{
    for (const std::shared_ptr<Camera> &camera : manager_->cameras())
        if (camera->id().find(device) != std::string::npos)
            return camera;
    return nullptr;
}

pf_status Session::acquire(const std::string &device, pf_failure *failure)
{
    std::shared_ptr<Camera> camera = find(device);
    if (!camera)
        return pf_fail(failure, PF_ERR_AGAIN, "libcamera: no camera%s%s", device.empty() ? "" : " ", device.c_str());
    id_ = camera->id();
    int error = camera->acquire();
    if (error != 0)
        return pf_fail(failure, error == -ENODEV ? PF_ERR_AGAIN : PF_ERR_IO, "%s: %s", id_.c_str(),
                       std::strerror(-error));
    camera_ = std::move(camera);
    isGone_ = false;
    camera_->requestCompleted.connect(this, &Session::onCompleted);
    camera_->disconnected.connect(this, &Session::onDisconnected);
    return PF_OK;
}

pf_status Session::configure(const pf_session_wish &wish, pf_session_info &info, pf_failure *failure)
{
    configuration_ = camera_->generateConfiguration({StreamRole::VideoRecording});
    if (!configuration_ || configuration_->empty())
        return pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: gives no video", id_.c_str());
    StreamConfiguration &stream = configuration_->at(0);
    const Size size = wish.width != 0 ? Size(wish.width, wish.height) : stream.size;
    uint32_t known;
    const pf_pixel_format *ours = pf_pixel_formats(&known);
    info.format = nullptr;
    for (uint32_t k = 0; k < known && info.format == nullptr; k++) {
        const auto *name = std::find_if(FORMATS.begin(), FORMATS.end(),
                                        [&](const FormatName &f) { return std::strcmp(f.ours, ours[k].name) == 0; });
        if (name == FORMATS.end() || (wish.format != nullptr && wish.format != &ours[k]))
            continue;
        stream.pixelFormat = name->theirs;
        stream.size = size;
        stream.bufferCount = wish.buffers;
        /* It may change what it is asked for. */
        if (configuration_->validate() != CameraConfiguration::Invalid && stream.pixelFormat == name->theirs &&
            stream.size == size)
            info.format = &ours[k];
    }
    if (info.format == nullptr) {
        std::string has;
        for (const PixelFormat &format : stream.formats().pixelformats())
            has.append(1, ' ').append(format.toString());
        return pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: cannot make frames of %u x %u%s%s; it has:%s", id_.c_str(),
                       size.width, size.height, wish.format ? " as " : " in a format that is read",
                       wish.format ? wish.format->name : "", has.c_str());
    }
    int error = camera_->configure(configuration_.get());
    if (error != 0)
        return pf_fail(failure, PF_ERR_IO, "%s: cannot be set up: %s", id_.c_str(), std::strerror(-error));
    stream_ = stream.stream();
    info.width = stream.size.width;
    info.height = stream.size.height;
    info.stride = std::max(stream.stride, pf_pixel_format_row(info.format, info.width));
    return PF_OK;
}

pf_status Session::mapBuffers(pf_failure *failure)
{
    allocator_ = std::make_unique<FrameBufferAllocator>(camera_);
    int n = allocator_->allocate(stream_);
    if (n < 0)
        return pf_fail(failure, PF_ERR_IO, "%s: gives no buffers: %s", id_.c_str(), std::strerror(-n));
    for (const std::unique_ptr<FrameBuffer> &frame : allocator_->buffers(stream_)) {
        if (buffers_.size() == PF_SESSION_BUFFERS_MAX)
            break;
        Buffer b;
        const FrameBuffer::Plane &plane = frame->planes().front();
        b.frame = frame.get();
        b.fd = plane.fd.get();
        b.offset = plane.offset == FrameBuffer::Plane::kInvalidOffset ? 0 : plane.offset;
        b.size = size_t{b.offset} + plane.length;
        void *memory = mmap(nullptr, b.size, PROT_READ, MAP_SHARED, b.fd, 0);
        if (memory == MAP_FAILED)
            return pf_fail(failure, PF_ERR_IO, "%s: a buffer cannot be mapped: %s", id_.c_str(), std::strerror(errno));
        b.memory = static_cast<uint8_t *>(memory);
        b.request = camera_->createRequest(buffers_.size());
        bool isWhole = b.request && b.request->addBuffer(stream_, b.frame) == 0;
        buffers_.push_back(std::move(b));
        if (!isWhole)
            return pf_fail(failure, PF_ERR_IO, "%s: takes no request", id_.c_str());
    }
    return PF_OK;
}

void Session::describeControls(const pf_session_wish &wish, pf_session_info &info)
{
    const ControlInfoMap &all = camera_->controls();
    hasTime_ = has(controls::ExposureTime);
    hasGain_ = has(controls::AnalogueGain);
    if (hasTime_) {
        const ControlInfo &range = all.at(controls::ExposureTime.id());
        info.time = {range.min().get<int32_t>(), range.max().get<int32_t>(), 1};
        hasTime_ = info.time.min < info.time.max;
    }
    if (hasGain_) {
        const ControlInfo &range = all.at(controls::AnalogueGain.id());
        info.gain = {std::max(int64_t{1}, static_cast<int64_t>(range.min().get<float>() * GAIN_UNIT)),
                     static_cast<int64_t>(range.max().get<float>() * GAIN_UNIT), 1};
        hasGain_ = info.gain.min < info.gain.max;
    }
    info.time_unit_us = 1;
    info.gain_unit = GAIN_UNIT;
    /* It does not tell what is set: a tenth of the longest exposure is a start that a few steps correct. */
    info.time_now = info.time.max / 10;
    info.gain_now = info.gain.min;
    info.has_time = hasTime_;
    info.has_gain = hasGain_;
    info.frame_rate = 0;
    first_ = ControlList(controls::controls);
    next_ = ControlList(controls::controls);
    if (wish.frame_rate > 0 && has(controls::FrameDurationLimits)) {
        const ControlInfo &range = all.at(controls::FrameDurationLimits.id());
        int64_t us = std::clamp(static_cast<int64_t>(1e6 / wish.frame_rate), range.min().get<int64_t>(),
                                range.max().get<int64_t>());
        const std::array<int64_t, 2> limits{us, us};
        first_.set(controls::FrameDurationLimits, Span<const int64_t, 2>(limits));
        info.frame_rate = 1e6 / static_cast<double>(us);
    }
}

pf_status Session::open(const pf_session_wish &wish, pf_session_info &info, pf_failure *failure)
{
    pf_status status = begin(failure);
    if (status == PF_OK)
        status = acquire(wish.device, failure);
    if (status == PF_OK) {
        (void)std::snprintf(info.id, sizeof info.id, "%s", id_.c_str());
        status = configure(wish, info, failure);
    }
    if (status == PF_OK)
        status = mapBuffers(failure);
    if (status != PF_OK) {
        close();
        return status;
    }
    info.buffers = static_cast<uint32_t>(buffers_.size());
    describeControls(wish, info);
    return PF_OK;
}

pf_status Session::start(pf_failure *failure)
{
    ControlList controls = first_;
    controls.merge(next_);
    int error = camera_->start(&controls);
    if (error != 0)
        return pf_fail(failure, PF_ERR_IO, "%s: does not start: %s", id_.c_str(), std::strerror(-error));
    isRunning_ = true;
    queueIdle();
    return PF_OK;
}

void Session::stop()
{
    if (!isRunning_)
        return;
    (void)camera_->stop(); /* what was queued has come back, cancelled, when this returns */
    isRunning_ = false;
    std::lock_guard<std::mutex> lock(mutex_);
    filled_.clear();
    for (Buffer &b : buffers_)
        if (b.state != State::held)
            b.state = State::idle;
}

/* One that is refused is tried again with the next frame. */
void Session::queueIdle()
{
    for (Buffer &b : buffers_) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (!isRunning_ || isGone_ || b.state != State::idle)
                continue;
            b.state = State::queued;
        }
        b.request->reuse(Request::ReuseBuffers);
        if (!next_.empty()) {
            b.request->controls().merge(next_);
            next_.clear();
        }
        if (camera_->queueRequest(b.request.get()) != 0) {
            std::lock_guard<std::mutex> lock(mutex_);
            b.state = State::idle;
        }
    }
}

/* In libcamera's thread. */
void Session::onCompleted(Request *request)
{
    std::lock_guard<std::mutex> lock(mutex_);
    const uint32_t i = static_cast<uint32_t>(request->cookie());
    if (request->status() == Request::RequestCancelled) {
        buffers_[i].state = State::idle;
        return;
    }
    buffers_[i].state = State::filled;
    filled_.push_back(i);
    change_.notify_one();
}

/* In libcamera's thread. */
void Session::onDisconnected()
{
    std::lock_guard<std::mutex> lock(mutex_);
    isGone_ = true;
    change_.notify_one();
}

/* Makes the processor see what the camera wrote, where the memory is not coherent; elsewhere it costs nothing. */
void synchronise(int fd, uint64_t flags)
{
    dma_buf_sync sync{flags | DMA_BUF_SYNC_READ};
    (void)ioctl(fd, DMA_BUF_IOCTL_SYNC, &sync);
}

pf_status Session::take(uint32_t timeout_ms, pf_session_frame &frame, pf_failure *failure)
{
    queueIdle();
    std::unique_lock<std::mutex> lock(mutex_);
    change_.wait_for(lock, std::chrono::milliseconds(timeout_ms), [this] { return isGone_ || !filled_.empty(); });
    if (isGone_)
        return pf_fail(failure, PF_ERR_CLOSED, "%s: has gone", id_.c_str());
    if (filled_.empty())
        return PF_ERR_AGAIN;
    frame.buffer = filled_.front();
    filled_.pop_front();
    Buffer &b = buffers_[frame.buffer];
    b.state = State::held;
    lock.unlock();

    const FrameMetadata &metadata = b.frame->metadata();
    const ControlList &said = b.request->metadata();
    const size_t capacity = b.size - b.offset;
    synchronise(b.fd, DMA_BUF_SYNC_START);
    frame.pixels = b.memory + b.offset;
    frame.n = metadata.planes().empty() ? 0 : metadata.planes()[0].bytesused;
    if (frame.n == 0 || frame.n > capacity) /* drivers of raw formats may leave it 0 */
        frame.n = capacity;
    frame.sequence = metadata.sequence;
    frame.stamp_ns = metadata.timestamp;
    frame.is_damaged = metadata.status != FrameMetadata::FrameSuccess;
    frame.exposure_us = static_cast<uint32_t>(std::max(0, said.get(controls::ExposureTime).value_or(0)));
    frame.gain = static_cast<double>(said.get(controls::AnalogueGain).value_or(0.0f));
    return PF_OK;
}

void Session::give(uint32_t i)
{
    synchronise(buffers_[i].fd, DMA_BUF_SYNC_END);
    {
        std::lock_guard<std::mutex> lock(mutex_);
        buffers_[i].state = State::idle;
    }
    queueIdle();
}

void Session::set(bool isAutomatic, int64_t time, int64_t gain)
{
    if (has(controls::AeEnable))
        next_.set(controls::AeEnable, isAutomatic);
    if (isAutomatic)
        return;
    if (hasTime_ && time != PF_SESSION_AS_IS)
        next_.set(controls::ExposureTime, static_cast<int32_t>(time));
    if (hasGain_ && gain != PF_SESSION_AS_IS)
        next_.set(controls::AnalogueGain, static_cast<float>(gain) / GAIN_UNIT);
}

void Session::keep(uint32_t i)
{
    Buffer &b = buffers_[i];
    synchronise(b.fd, DMA_BUF_SYNC_END);
    (void)pf_mapping_keep(b.memory, b.size); /* without memory the old device stays open until the frame is released */
    kept_.push_back({b.memory + b.offset, b.memory, b.size});
    b.memory = nullptr;
}

void Session::drop(uint8_t *pixels)
{
    for (auto k = kept_.begin(); k != kept_.end(); k++) {
        if (k->pixels == pixels) {
            (void)munmap(k->memory, k->size);
            kept_.erase(k);
            return;
        }
    }
}

void Session::close()
{
    stop();
    if (camera_) {
        camera_->requestCompleted.disconnect(this);
        camera_->disconnected.disconnect(this);
    }
    for (Buffer &b : buffers_)
        if (b.memory != nullptr)
            (void)munmap(b.memory, b.size);
    buffers_.clear(); /* requests before the buffers that they name */
    filled_.clear();
    allocator_.reset();
    configuration_.reset();
    if (camera_)
        (void)camera_->release();
    camera_.reset();
    manager_.reset();
}

/* ---- as pf_session_io */

Session &of(void *self)
{
    return *static_cast<Session *>(self);
}

const pf_session_io TEMPLATE = {
    nullptr,
    [](void *) { return now_ns(); },
    [](void *, uint32_t ms) { std::this_thread::sleep_for(std::chrono::milliseconds(ms)); },
    [](void *self, const pf_session_wish *wish, pf_session_info *info, pf_failure *failure) {
        return of(self).open(*wish, *info, failure);
    },
    [](void *self, pf_failure *failure) { return of(self).start(failure); },
    [](void *self) { of(self).stop(); },
    [](void *self, uint32_t timeout_ms, pf_session_frame *frame, pf_failure *failure) {
        return of(self).take(timeout_ms, *frame, failure);
    },
    [](void *self, uint32_t i) { of(self).give(i); },
    [](void *self, bool isAutomatic, int64_t time, int64_t gain) { of(self).set(isAutomatic, time, gain); },
    [](void *self, uint32_t i) { of(self).keep(i); },
    [](void *self, uint8_t *pixels) { of(self).drop(pixels); },
    [](void *self) { of(self).close(); },
    [](void *self) { delete static_cast<Session *>(self); },
};

} /* namespace */

pf_status pf_session_libcamera(pf_session_io *io, pf_failure *failure)
{
    auto *session = new (std::nothrow) Session;
    if (session == nullptr)
        return pf_fail(failure, PF_ERR_SPACE, "libcamera: no memory");
    *io = TEMPLATE;
    io->self = session;
    return PF_OK;
}
