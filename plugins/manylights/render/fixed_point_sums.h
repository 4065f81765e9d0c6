#pragma once

/**
 * Colours at any places of a film, summed as integers: in any order, on any number of threads, the
 * sums have the same bits.
 */

#include "film_channels.h"
#include <atomic>
#include <drjit/jit.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/imageblock.h>
#include <vector>

namespace manylights {

template <typename Float, typename Spectrum> class FixedPointSums {
public:
    MI_IMPORT_TYPES(Film, ImageBlock, ReconstructionFilter)
    /// How much larger than the mean of a lamp a value may be: others are cut off
    static constexpr float kHeadroom = 0x1p14f;

    /**
     * @param most      no sum of a pixel exceeds this many times \ref kHeadroom
     * @param channels  what the film has beside colours
     * @param groups    of lights that have layers
     */
    FixedPointSums(Film *film, const Float &most, const FilmChannels &channels,
                   uint32_t groups)
        : m_film(film), m_size(film->crop_size()), m_filter(film->rfilter()),
          m_box(m_filter->is_box_filter()), m_reach(m_box ? 0 : m_filter->border_size()) {
        size_t others = own_channels(film);
        add_channels(0);
        for (size_t emission : channels.emissions)
            add_channels(others + emission);
        m_first_group = (uint32_t) m_channels.size();
        for (uint32_t group = 0; group < groups; ++group)
            add_channels(others + channels.groups + 3 * group);
        m_sums = make(m_channels.size() * dr::prod(m_size));
        // A power of two, from the exponent of `most`
        Int32 exponent = Int32(dr::reinterpret_array<UInt32>(most) >> 23u) - 127,
              digits   = dr::clip(62 - 14 - 1 - exponent, -100, 100);
        m_unit         = power_of_two(-digits);
        m_scale        = power_of_two(digits);
    }

    /// What a point of a lamp adds: to the image, to its own emission in sight, and to its group
    struct Value {
        Color3f arrives, emission;
        UInt32 group;
    };

    /// Add it at a place of the film, in pixels from the first one of the crop window
    void add(const Point2f &place, const Value &value, const Mask &active) {
        Vector2i first(dr::floor(place));
        first -= (int) m_reach;
        Vector2f from = Vector2f(first) + .5f - place;
        uint32_t side = 2 * m_reach + 1;
        for (uint32_t row = 0; row < side; ++row)
            for (uint32_t column = 0; column < side; ++column) {
                Vector2i pixel = first + Vector2i((int) column, (int) row);
                Float weight   = m_box ? Float(1.f)
                                       : filter(from.x() + (ScalarFloat) column) *
                                             filter(from.y() + (ScalarFloat) row);
                Mask inside    = active && dr::all(pixel >= 0) &&
                                 pixel.x() < (int) m_size.x() &&
                                 pixel.y() < (int) m_size.y();
                UInt32 index(pixel.y() * (int) m_size.x() + pixel.x());
                add(index, value, weight, inside);
            }
    }

    /// Make them part of the film
    void put() const {
        mitsuba::ref<ImageBlock> block =
            m_film->create_block(m_size, /* normalize = */ false, /* border = */ false);
        block->set_offset(m_film->crop_offset());
        uint32_t channels = (uint32_t) block->channel_count(), pixels = dr::prod(m_size);
        for (uint32_t i = 0; i < count(); ++i) {
            if constexpr (dr::is_jit_v<Float>) {
                UInt32 pixel = dr::arange<UInt32>(pixels);
                dr::scatter(block->tensor().array(),
                            Float(dr::reinterpret_array<Int64>(
                                dr::gather<UInt64>(m_sums, pixel * count() + i))) *
                                m_unit,
                            pixel * channels + m_channels[i]);
            } else {
                Float *data = block->tensor().array().data();
                for (uint32_t pixel = 0; pixel < pixels; ++pixel)
                    data[pixel * channels + m_channels[i]] =
                        (Float) (int64_t) m_sums[pixel * count() + i] * m_unit;
            }
        }
        m_film->put_block(block);
    }

private:
    /// Unsigned, as atomic additions on GPUs are: those of negative numbers are the same
    using Sums = std::conditional_t<dr::is_jit_v<Float>, UInt64,
                                    std::vector<std::atomic<uint64_t>>>;

    static Sums make(size_t size) {
        if constexpr (dr::is_jit_v<Float>)
            return dr::zeros<UInt64>(size);
        else
            return Sums(size);
    }

    static Float power_of_two(const Int32 &exponent) {
        return dr::reinterpret_array<Float>(UInt32(exponent + 127) << 23u);
    }

    /// As samples of cameras get it
    Float filter(const Float &x) const {
        if constexpr (dr::is_jit_v<Float>)
            return m_filter->eval(x);
        else
            return m_filter->eval_discretized(x);
    }

    void add(const UInt32 &pixel, const Value &value, const Float &weight,
             const Mask &active) {
        UInt32 first = pixel * count();
        add_color(first, value.arrives * weight, active);
        for (uint32_t i = 3; i < m_first_group; i += 3)
            add_color(first + i, value.emission * weight, active);
        if (m_first_group < count())
            add_color(first + m_first_group + value.group * 3u, value.arrives * weight,
                      active);
    }

    void add_color(const UInt32 &index, const Color3f &color, const Mask &active) {
        for (uint32_t i = 0; i < 3; ++i) {
            UInt64 number =
                dr::reinterpret_array<UInt64>(Int64(dr::round(color.entry(i) * m_scale)));
            if constexpr (dr::is_jit_v<Float>)
                dr::scatter_reduce(ReduceOp::Add, m_sums, number, index + i, active);
            else if (active)
                m_sums[index + i].fetch_add(number, std::memory_order_relaxed);
        }
    }

    /// Numbers of a pixel
    uint32_t count() const { return (uint32_t) m_channels.size(); }

    void add_channels(size_t first) {
        for (size_t i = 0; i < 3; ++i)
            m_channels.push_back((uint32_t) (first + i));
    }

    Film *m_film;
    mitsuba::Vector<uint32_t, 2> m_size;
    const ReconstructionFilter *m_filter;
    bool m_box;
    /// Pixels that a value reaches on each side
    uint32_t m_reach;
    /// Of the film, for each number: colours, those of emission, those of each group
    std::vector<uint32_t> m_channels;
    uint32_t m_first_group;
    Sums m_sums;
    /// Of the integers, and its inverse
    Float m_unit, m_scale;
};

} // namespace manylights
