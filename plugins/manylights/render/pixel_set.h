#pragma once

/**
 * Which pixels a pass has. One of each block of 4 x 4 trains, wherever a hash puts it.
 */

#include "manylights/base/divide.h"
#include "pass_plan.h"
#include <mitsuba/core/random.h>

namespace manylights {

namespace dr = drjit;

/// Coordinates count from the film's first pixel
template <typename UInt32> class PixelSet {
public:
    using Mask = dr::mask_t<UInt32>;
    /// Of the blocks
    static constexpr uint32_t kSide = 4;

    struct Pixel {
        UInt32 x, y;
        Mask active;
    };
    /// The number of a pixel in the set, if it is in there
    struct Number {
        UInt32 index;
        Mask active;
    };

    /// @param seed  of the rendering: what trains is the same in all of its passes
    PixelSet(uint32_t width, uint32_t height, Role role, const UInt32 &seed)
        : m_width(width), m_height(height), m_columns((width + kSide - 1) / kSide),
          m_role(role), m_seed(seed) {}

    /// How many numbers there are
    uint32_t size() const {
        return trains() ? m_columns * ((m_height + kSide - 1) / kSide)
                        : m_width * m_height;
    }

    Pixel pixel(const UInt32 &number) const {
        auto [y, x] = divide(number, trains() ? m_columns : m_width);
        if (m_role == Role::All)
            return { x, y, Mask(true) };
        if (m_role == Role::Rest)
            return { x, y, !is_trained(x, y) };
        auto [trained_x, trained_y] = in_block(x, y);
        return { trained_x, trained_y, trained_x < m_width && trained_y < m_height };
    }

    /// Coordinates may be beyond the borders, as unsigned numbers
    Number number(const UInt32 &x, const UInt32 &y) const {
        Mask inside = x < m_width && y < m_height;
        if (!trains())
            return { dr::fmadd(y, m_width, x), inside };
        return { dr::fmadd(y / kSide, m_columns, x / kSide), inside && is_trained(x, y) };
    }

    /// Is a pixel within the borders in the set?
    Mask contains(const UInt32 &x, const UInt32 &y) const {
        return m_role == Role::All ? Mask(true) : is_trained(x, y) == Mask(trains());
    }

private:
    bool trains() const { return m_role == Role::Train; }

    /// The pixel of a block that trains
    std::pair<UInt32, UInt32> in_block(const UInt32 &column, const UInt32 &row) const {
        UInt32 hash = mitsuba::sample_tea_32(row * m_columns + column, m_seed).first;
        return { column * kSide + (hash & 3u), row * kSide + ((hash >> 2u) & 3u) };
    }

    Mask is_trained(const UInt32 &x, const UInt32 &y) const {
        auto [trained_x, trained_y] = in_block(x / kSide, y / kSide);
        return x == trained_x && y == trained_y;
    }

    uint32_t m_width, m_height, m_columns;
    Role m_role;
    UInt32 m_seed;
};

} // namespace manylights
