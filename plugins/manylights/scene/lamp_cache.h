#pragma once

/**
 * The lamps in view of the cameras that some lights have been rendered with: to find them takes
 * time for each light, and passes, frames and sensors come again.
 */

#include "lamps_in_view.h"
#include <array>

namespace manylights {

template <typename Float, typename Spectrum> class LampCache {
public:
    using Lights = SceneLights<Float, Spectrum>;
    using Lamps  = LampsInView<Float, Spectrum>;
    using Sensor = mitsuba::Sensor<Float, Spectrum>;

    /// Null if no lamp is worth it. The lights are those of all calls before, as they were
    std::shared_ptr<const Lamps> find(const Lights &lights, const Sensor *sensor,
                                      const mitsuba::Vector<uint32_t, 2> &size) {
        if (!Lamps::may_find(lights, sensor))
            return {};
        Entry wanted{ read_view(sensor), size, Lamps::border(sensor), {} };
        for (const Entry &entry : m_entries)
            if (entry.size.x() > 0 && entry.is_alike(wanted))
                return entry.lamps;
        wanted.lamps = Lamps::choose(lights, wanted.camera, size, wanted.border);
        return (m_entries[m_next++ % kMost] = std::move(wanted)).lamps;
    }

    /// The lights have changed
    void clear() { m_entries = {}; }

private:
    /// Each keeps a number for each light
    static constexpr size_t kMost = 8;

    struct Entry {
        CameraView<float> camera;
        mitsuba::Vector<uint32_t, 2> size{ 0, 0 };
        uint32_t border = 0;
        std::shared_ptr<const Lamps> lamps;

        bool is_alike(const Entry &other) const {
            return camera == other.camera && dr::all(size == other.size) &&
                   border == other.border;
        }
    };

    std::array<Entry, kMost> m_entries;
    size_t m_next = 0;
};

} // namespace manylights
