#pragma once

/**
 * Samples of JIT variants that were evaluated become part of a film: each of its pixels adds
 * the samples within the reach of its filter in a fixed order. The sums do not depend on how
 * threads share the work, as those of atomic additions would.
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

    /// How many numbers \ref add stores for each pixel, beside the samples
    static uint32_t stored(const Film *film, size_t channels) {
        const ReconstructionFilter *filter = film->rfilter();
        return filter->is_box_filter() ? 0 : side(filter->border_size()) * channels;
    }

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
        Values lines;
        if (!m_box)
            lines = sum_rows(samples, width, rows);
        UInt32 pixel = dr::arange<UInt32>(width * (end - begin));
        auto [y, x]  = divide(pixel, width);
        y += dr::opaque<UInt32>(begin + m_border);
        Values sums = m_box ? add_pixel(samples, x + m_border, y, Float(0.f),
                                        zeros(samples.channels.size()))
                            : sum_lines(lines, x, y, rows, samples.channels.size());

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

    /// Pixels that a sample reaches along one axis
    static uint32_t side(uint32_t reach) { return 2 * reach + 1; }

    /// The weight of a sample is a product. So rows are summed first: for each of their
    /// pixels the sums of its neighbours on the left and right, channels for each of the
    /// distances at which a row of the film may be.
    Values sum_rows(const Samples &samples, uint32_t width,
                    std::pair<uint32_t, uint32_t> rows) const {
        UInt32 lane = dr::arange<UInt32>(width * (rows.second - rows.first));
        auto [y, x] = divide(lane, width);
        y += dr::opaque<UInt32>(rows.first);
        UInt32 left = x + (m_border - m_reach), column = 0;
        Values lines = zeros(side(m_reach) * samples.channels.size());

        std::tie(column, lines) = dr::while_loop(
            std::make_tuple(column, lines),
            [this](const UInt32 &column, const Values &) {
                return column < side(m_reach);
            },
            [&, left = left, y = y](UInt32 &column, Values &lines) {
                lines = add_pixel(samples, left + column, y,
                                  Float(m_reach) + .5f - Float(column), lines);
                column += 1;
            },
            "Film: columns");
        for (size_t i = 0; i < lines.size(); ++i)
            dr::schedule(lines.entry(i));
        dr::eval();
        return lines;
    }

    /// The film's pixels: those of all rows in reach
    Values sum_lines(const Values &lines, const UInt32 &x, const UInt32 &y,
                     std::pair<uint32_t, uint32_t> rows, size_t channels) const {
        Values sums  = zeros(channels);
        UInt32 count = dr::opaque<UInt32>(rows.second - rows.first),
               first = dr::opaque<UInt32>(rows.first),
               width = dr::opaque<UInt32>(m_film->crop_size().x());
        for (uint32_t row = 0; row < side(m_reach); ++row) {
            UInt32 number = y + (row - m_reach) - first;
            Mask active   = number < count;
            UInt32 index  = dr::fmadd(number, width, x);
            for (size_t i = 0; i < channels; ++i)
                sums.entry(i) +=
                    dr::gather<Float>(lines.entry(row * channels + i), index, active);
        }
        return sums;
    }

    /**
     * Adds the samples of the pixel at x, y.
     * @param center  the middle of the column that is summed, in relation to the pixel
     * @param sums    channels for each row in reach
     */
    Values add_pixel(const Samples &samples, const UInt32 &x, const UInt32 &y,
                     const Float &center, Values sums) const {
        auto number = m_pixels.number(x, y);
        number.index -= dr::opaque<UInt32>(samples.first);
        number.active &= number.index < dr::opaque<UInt32>(samples.count);
        if (samples.per_number == 1) {
            add_sample(samples, number.index, number.active, center, sums);
            return sums;
        }
        UInt32 lane = number.index * dr::opaque<UInt32>(samples.per_number),
               end  = dr::select(number.active,
                                 lane + dr::opaque<UInt32>(samples.per_number), lane);
        std::tie(lane, sums) = dr::while_loop(
            std::make_tuple(lane, sums),
            [&end](const UInt32 &lane, const Values &) { return lane < end; },
            [&](UInt32 &lane, Values &sums) {
                add_sample(samples, lane, Mask(true), center, sums);
                lane += 1;
            },
            "Film: samples");
        return sums;
    }

    void add_sample(const Samples &samples, const UInt32 &lane, const Mask &active,
                    const Float &center, Values &sums) const {
        size_t channels = samples.channels.size();
        Values values   = zeros(channels);
        for (size_t i = 0; i < channels; ++i)
            values.entry(i) = dr::width(samples.channels[i]) == 1
                                  ? dr::select(active, samples.channels[i], 0.f)
                                  : dr::gather<Float>(samples.channels[i], lane, active);
        if (m_box) {
            for (size_t i = 0; i < channels; ++i)
                sums.entry(i) += values.entry(i);
            return;
        }
        Float weight_x = m_filter->eval(
                  center - dr::gather<Float>(samples.offset.x(), lane, active)),
              offset_y = dr::gather<Float>(samples.offset.y(), lane, active);
        for (uint32_t row = 0; row < side(m_reach); ++row) {
            Float middle = (ScalarFloat) m_reach + .5f - (ScalarFloat) row,
                  weight = weight_x * m_filter->eval(middle - offset_y);
            // What is out of reach may be infinite
            Mask counts = weight != 0.f;
            for (size_t i = 0; i < channels; ++i) {
                Float &sum = sums.entry(row * channels + i);
                sum = dr::select(counts, dr::fmadd(values.entry(i), weight, sum), sum);
            }
        }
    }

    static Values zeros(size_t count) {
        Values result = dr::empty<Values>(count);
        for (size_t i = 0; i < count; ++i)
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
