#pragma once

/// Which pixels train: one of each block of 4 x 4, wherever a hash puts it

#include <mitsuba/core/random.h>
#include <utility>

namespace manylights {

/// Pixels of a film as blocks of 4 x 4; coordinates count from the film's first pixel
template <typename UInt32> class TrainingPixels {
public:
    static constexpr uint32_t kSide = 4;

    TrainingPixels(uint32_t width, uint32_t height, const UInt32 &seed)
        : columns((width + kSide - 1) / kSide), rows((height + kSide - 1) / kSide),
          m_seed(seed) {}

    /// The pixel of a block that trains
    std::pair<UInt32, UInt32> in_block(const UInt32 &column, const UInt32 &row) const {
        UInt32 hash = mitsuba::sample_tea_32(row * columns + column, m_seed).first;
        return { column * kSide + (hash & 3u), row * kSide + ((hash >> 2u) & 3u) };
    }

    /// Does a pixel train?
    auto contains(const UInt32 &x, const UInt32 &y) const {
        auto [trained_x, trained_y] = in_block(x / kSide, y / kSide);
        return (x == trained_x) & (y == trained_y);
    }

    const uint32_t columns, rows;

private:
    UInt32 m_seed;
};

} // namespace manylights
