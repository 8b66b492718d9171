#include "sim/telemetry.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

// What sudden slips have added between 0 and `driven` metres. Each centimetre has one with the chance rate / 100.
class SuddenSlips
{
public:
    explicit SuddenSlips(const TelemetrySpec &spec) : spec_(spec) {}

    double until(double driven)
    {
        double sum = 0.0;
        for (const EncoderSlip &slip : spec_.slips) {
            sum += driven >= slip.at ? slip.metres : 0.0;
        }
        const int64_t cell = static_cast<int64_t>(std::floor(std::max(driven, furthest_) / CELL));
        for (; spec_.slip_rate > 0.0 && next_ <= cell; next_++) {
            const uint64_t n = static_cast<uint64_t>(next_);
            if (uniform_of(hash64(spec_.seed, STREAM_SLIP_EVENT, n, 0)) < spec_.slip_rate * CELL) {
                random_ += spec_.slip_m * (0.5 + uniform_of(hash64(spec_.seed, STREAM_SLIP_EVENT, n, 1)));
            }
        }
        furthest_ = std::max(driven, furthest_);
        return sum + random_;
    }

private:
    static constexpr double CELL = 0.01; // metres
    const TelemetrySpec &spec_;
    double furthest_ = 0.0, random_ = 0.0;
    int64_t next_ = 1; // none at the start
};

} // namespace

std::vector<Reading> measure(const std::vector<FrameState> &frames, const TelemetrySpec &spec)
{
    std::vector<Reading> readings;
    SuddenSlips sudden(spec);
    double slip = 0.0, before = 0.0;
    int lost = 0;
    for (size_t i = 0; i < frames.size(); i++) {
        const FrameState &f = frames[i];
        Reading r{};
        const double driven = spec.cable ? f.pushed : f.arc;
        slip += spec.encoder_slip * std::sqrt(std::abs(driven - before)) * normal(spec.seed, STREAM_SLIP, i);
        before = driven;
        const double counted = driven * (1.0 + spec.encoder_bias) + slip + sudden.until(driven);
        r.encoder_count = static_cast<int64_t>(
            std::floor(counted / spec.metres_per_count + spec.encoder_noise * normal(spec.seed, STREAM_ENCODER, i)));
        r.roll = f.roll + spec.roll_bias + spec.attitude_sigma * normal(spec.seed, STREAM_ROLL, i);
        r.pitch = f.pitch + spec.pitch_bias + spec.attitude_sigma * normal(spec.seed, STREAM_PITCH, i);
        r.time_ns = std::llround((f.time + spec.time_jitter_s * normal(spec.seed, STREAM_CLOCK, i)) * 1e9);
        r.time_ns = std::max<int64_t>(r.time_ns, i > 0 ? readings.back().time_ns + 1 : 0);
        lost = std::max(0, lost - 1);
        if (i > 0 && uniform_of(hash64(spec.seed, STREAM_DROP, i, 0)) < spec.drop_rate) {
            const double u = uniform_of(hash64(spec.seed, STREAM_DROP, i, 1));
            lost = std::max(lost, 1 + static_cast<int>(u * spec.drop_longest));
        }
        r.dropped = lost > 0;
        readings.push_back(r);
    }
    return readings;
}

} // namespace pipefish::sim
