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
          m_role(role), m_seed(seed), m_trains(role == Role::Train) {
        // One kernel for all seeds, and for those that train and the rest
        if (role != Role::All)
            dr::make_opaque(m_seed, m_trains);
    }

    /// How many numbers there are
    uint32_t size() const {
        return m_role == Role::All
                   ? m_width * m_height
                   : m_columns * ((m_height + kSide - 1) / kSide) * per_block();
    }

    /// Rows from that of a number's pixel on, as a block or the image has them
    uint32_t row(uint32_t number) const {
        return m_role == Role::All ? number / m_width
                                   : number / (m_columns * per_block()) * kSide;
    }

    Pixel pixel(const UInt32 &number) const {
        if (m_role == Role::All) {
            auto [y, x] = divide(number, m_width);
            return { x, y, Mask(true) };
        }
        auto [block, rest] = divide(number, per_block());
        auto [row, column] = divide(block, m_columns);
        UInt32 place       = trained(column, row);
        place    = dr::select(m_trains, place,
                              rest + dr::select(rest >= place, UInt32(1), UInt32(0)));
        UInt32 x = column * kSide + place % kSide, y = row * kSide + place / kSide;
        return { x, y, x < m_width && y < m_height };
    }

    /// Coordinates may be beyond the borders, as unsigned numbers
    Number number(const UInt32 &x, const UInt32 &y) const {
        Mask inside = x < m_width && y < m_height;
        if (m_role == Role::All)
            return { dr::fmadd(y, m_width, x), inside };
        UInt32 column = x / kSide, row = y / kSide,
               block = dr::fmadd(row, m_columns, column), out = trained(column, row),
               place = place_in_block(x, y);
        UInt32 rest  = place - dr::select(place > out, UInt32(1), UInt32(0));
        return { dr::fmadd(block, dr::opaque<UInt32>(per_block()),
                           dr::select(m_trains, UInt32(0), rest)),
                 inside && (place == out) == m_trains };
    }

    /// Is a pixel within the borders in the set?
    Mask contains(const UInt32 &x, const UInt32 &y) const {
        return m_role == Role::All ? Mask(true) : is_trained(x, y) == m_trains;
    }

private:
    uint32_t per_block() const { return m_role == Role::Train ? 1 : kSide * kSide - 1; }

    /// Place of the pixel of a block that trains
    UInt32 trained(const UInt32 &column, const UInt32 &row) const {
        return mitsuba::sample_tea_32(row * m_columns + column, m_seed).first %
               (kSide * kSide);
    }

    static UInt32 place_in_block(const UInt32 &x, const UInt32 &y) {
        return (y % kSide) * kSide + x % kSide;
    }

    Mask is_trained(const UInt32 &x, const UInt32 &y) const {
        return place_in_block(x, y) == trained(x / kSide, y / kSide);
    }

    uint32_t m_width, m_height, m_columns;
    Role m_role;
    UInt32 m_seed;
    Mask m_trains;
};

} // namespace manylights
