#pragma once

/**
 * Samples of JIT variants that were evaluated become part of a film: each of its pixels adds
 * the samples within the reach of its filter, one after the other. The sums do not depend on
 * how threads share the work, as those of atomic additions would.
 */

#include "pixel_set.h"
#include <drjit/util.h>
#include <drjit/while_loop.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/imageblock.h>
#include <vector>

namespace manylights {

template <typename Float, typename Spectrum> class FilmSums {
public:
    MI_IMPORT_TYPES(Film, ImageBlock, ReconstructionFilter)
    using Pixels = PixelSet<UInt32>;

    /// Samples of the numbers from `first` on of a set: all those of a number follow each other
    struct Samples {
        uint32_t first, count, per_number;
        /// Channels of the film, and the place within the pixel
        std::vector<Float> channels;
        Vector2f offset;
    };

    FilmSums(Film *film, const mitsuba::Vector<uint32_t, 2> &size, const Pixels &pixels)
        : m_film(film), m_size(size), m_pixels(pixels), m_filter(film->rfilter()),
          m_box(m_filter->is_box_filter()), m_reach(m_box ? 0 : m_filter->border_size()),
          m_border(film->sample_border() ? m_filter->border_size() : 0) {}

    /// @param rows  rendered rows that have samples: the first, and the one after the last
    void add(const Samples &samples, std::pair<uint32_t, uint32_t> rows) const {
        // Rows of the film that they reach
        int below       = (int) rows.first - (int) (m_reach + m_border),
            above       = (int) rows.second + (int) m_reach - (int) m_border;
        uint32_t height = m_film->crop_size().y(), width = m_film->crop_size().x(),
                 begin = (uint32_t) std::max(below, 0),
                 end   = std::min((uint32_t) std::max(above, 0), height);
        if (begin >= end)
            return;
        UInt32 pixel = dr::arange<UInt32>(width * (end - begin));
        auto [y, x]  = divide(pixel, width);
        Values sums =
            gather(samples, x + m_border, y + dr::opaque<UInt32>(begin + m_border));

        mitsuba::ref<ImageBlock> block = m_film->create_block(
            { width, end - begin }, /* normalize = */ false, /* border = */ false);
        block->set_offset(m_film->crop_offset() + mitsuba::Vector<uint32_t, 2>(0, begin));
        // All channels at once, so that there is one kernel
        dr::scatter_reduce_packet_dynamic(ReduceOp::Add, samples.channels.size(),
                                          block->tensor().array(), sums.data(), pixel,
                                          Mask(true), ReduceMode::NoConflicts);
        m_film->put_block(block);
    }

private:
    using Values = dr::DynamicArray<Float>;

    /// The sums of the pixels at x, y
    Values gather(const Samples &samples, const UInt32 &x, const UInt32 &y) const {
        Values sums = zeros(samples);
        if (m_reach == 0)
            return add_pixel(samples, x, y, UInt32(0), UInt32(0), sums);
        uint32_t side = 2 * m_reach + 1;
        UInt32 row = 0, column = 0;
        std::tie(row, column, sums) = dr::while_loop(
            std::make_tuple(row, column, sums),
            [side](const UInt32 &row, const UInt32 &, const Values &) {
                return row < side;
            },
            [&](UInt32 &row, UInt32 &column, Values &sums) {
                sums = add_pixel(samples, x, y, column, row, sums);
                column += 1;
                Mask next = column == side;
                row += dr::select(next, UInt32(1), UInt32(0));
                column = dr::select(next, UInt32(0), column);
            },
            "Film: pixels");
        return sums;
    }

    /// Adds the samples of a pixel in reach
    Values add_pixel(const Samples &samples, const UInt32 &x, const UInt32 &y,
                     const UInt32 &column, const UInt32 &row,
                     const Values &before) const {
        auto number = m_pixels.number(x + column - m_reach, y + row - m_reach);
        number.index -= dr::opaque<UInt32>(samples.first);
        number.active &= number.index < dr::opaque<UInt32>(samples.count);
        UInt32 lane    = number.index * dr::opaque<UInt32>(samples.per_number),
               end     = dr::select(number.active,
                                    lane + dr::opaque<UInt32>(samples.per_number), lane);
        Float center_x = Float(m_reach) + .5f - Float(column),
              center_y = Float(m_reach) + .5f - Float(row);
        Values sums    = zeros(samples);
        std::tie(lane, sums) = dr::while_loop(
            std::make_tuple(lane, sums),
            [&end](const UInt32 &lane, const Values &) { return lane < end; },
            [&](UInt32 &lane, Values &sums) {
                Float weight = 1.f;
                if (!m_box)
                    weight = m_filter->eval(center_x -
                                            dr::gather<Float>(samples.offset.x(), lane)) *
                             m_filter->eval(center_y -
                                            dr::gather<Float>(samples.offset.y(), lane));
                Mask counts = weight != 0.f;
                for (size_t i = 0; i < samples.channels.size(); ++i) {
                    const Float &channel = samples.channels[i];
                    Float value          = dr::width(channel) == 1
                                               ? channel
                                               : dr::gather<Float>(channel, lane);
                    sums.entry(i)        = dr::select(
                        counts, dr::fmadd(value, weight, sums.entry(i)), sums.entry(i));
                }
                lane += 1;
            },
            "Film: samples");
        for (size_t i = 0; i < samples.channels.size(); ++i)
            sums.entry(i) += before.entry(i);
        return sums;
    }

    static Values zeros(const Samples &samples) {
        Values result = dr::empty<Values>(samples.channels.size());
        for (size_t i = 0; i < samples.channels.size(); ++i)
            result.entry(i) = Float(0.f);
        return result;
    }

    Film *m_film;
    mitsuba::Vector<uint32_t, 2> m_size;
    const Pixels &m_pixels;
    const ReconstructionFilter *m_filter;
    bool m_box;
    /// Pixels that a sample reaches on each side, and those beyond the film's border
    uint32_t m_reach, m_border;
};

} // namespace manylights
