#pragma once

/**
 * How large lamps are on the film, and how many points each gets there (lamps_in_view.h).
 *
 * Plain numbers on the host: computed once for a camera, on all threads.
 */

#include "camera_view.h"
#include "manylights/base/host_memory.h"
#include "manylights/kinds/kinds.h"

namespace manylights {

/// The image of a lamp, blurred by the lens
struct LampImage {
    /// Pixels that it touches, and the share of them that it covers: that of camera rays that
    /// hit it. Both are 0 for what is out of sight
    float touched = 0, share = 0;

    /**
     * @param size    pixels that are rendered
     * @param border  of them, those beyond each side of the film
     */
    static LampImage of(const LightRow &row, const CameraView<float> &camera,
                        const mitsuba::Vector<uint32_t, 2> &size, uint32_t border) {
        auto seen   = with_kind(kind_of(row), [&](auto light) {
            return light.appearance(Row<float>{ row.geometry }, camera.position, 0.f);
        });
        auto center = camera.position + seen.w;
        float depth = camera.depth(center);
        if (!(seen.intensity > 0 && depth > camera.near_clip && depth < camera.far_clip))
            return {};
        float diameter = light_diameter(row);
        if (!(diameter > 0 && depth - diameter > camera.near_clip))
            return {};
        float density = camera.pixels() / (depth * depth),
              covered = density * seen.intensity * dr::norm(seen.w) / depth,
              extent  = diameter * std::sqrt(density),
              blur    = camera.radius * std::abs(camera.inverse_focus - 1 / depth) *
                        std::sqrt(camera.pixels());
        auto at       = camera.on_film(center, camera.position);
        float margin  = (float) border + extent + blur;
        for (size_t i = 0; i < 2; ++i)
            if (!(at[i] > -margin && at[i] < (float) (size[i] - 2 * border) + margin))
                return {};
        // The area of what is blurred with a disk and a pixel
        float touched =
            covered + 2 * extent + 1 + blur * (2 * extent + 4 + dr::Pi<float> * blur);
        return covered > 0 && std::isfinite(touched)
                   ? LampImage{ touched, covered / touched }
                   : LampImage();
    }
};

/**
 * How many points the lamps of a table get for each sample of the pixels.
 *
 * Where a lamp adds L k to a pixel, with the share k of its camera rays, and others add B, the
 * square of the relative error is (L k)^2 / ((B + L k)^2 (k + r)) with r points for each pixel that
 * the lamp touches. Of all r with one sum the best ones are k + r = s L k / (B + L k), or 0 where
 * camera rays do well alone; s is at most 1.
 */
class LampPoints {
public:
    LampPoints(const LightRow *rows, uint32_t count, const CameraView<float> &camera,
               const mitsuba::Vector<uint32_t, 2> &size, uint32_t border)
        : m_chunks(chunk_count(count)) {
        for_chunks(count, [&](size_t chunk, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                m_chunks[chunk].add((uint32_t) i, rows[i],
                                    LampImage::of(rows[i], camera, size, border));
        });
        double light = 0, pixels = (double) size.x() * size.y();
        for (const Chunk &chunk : m_chunks)
            light += chunk.light;
        compare(kOthers * light / pixels);
        if (sum() <= kMostPoints * pixels)
            return;
        for (double step = .5; step > 1e-3; step *= .5)
            m_scale += sum() > kMostPoints * pixels ? -step : step;
    }

    /// Call f(light, points, brightness) for all lamps that may get any, in their order
    template <typename F> void for_each(const F &f) const {
        for (const Chunk &chunk : m_chunks)
            for (const SmallLamp &lamp : chunk.small)
                f(lamp.light, points(lamp), lamp.brightness);
    }

private:
    /// Of all lamps, for each pixel and sample: a point takes a small part of a sample's time
    static constexpr double kMostPoints = 2;
    /// The light B of a pixel, of the mean of all that lamps may show: many are hidden
    static constexpr double kOthers = .1;
    /// Above this share a lamp is large: camera rays do well alone
    static constexpr float kMostShare = .25f;

    struct SmallLamp {
        uint32_t light;
        float brightness;
        LampImage image;
        /// Of the light in a pixel: L k / (B + L k)
        double part;
    };

    /// Those of some lights of the table, and the light of all of these on the film
    struct Chunk {
        std::vector<SmallLamp> small;
        double light = 0;

        void add(uint32_t i, const LightRow &row, const LampImage &image) {
            if (!(image.touched > 0))
                return;
            light += (double) row.brightness * image.touched * image.share;
            if (image.share < kMostShare)
                small.push_back({ i, row.brightness, image, 0 });
        }
    };

    /// Set the parts of lamps where others add the light `others`
    void compare(double others) {
        for_each_chunk([&](size_t i) {
            for (SmallLamp &lamp : m_chunks[i].small) {
                double light = lamp.brightness * lamp.image.share;
                lamp.part    = light > 0 ? light / (others + light) : 0;
            }
        });
    }

    double points(const SmallLamp &lamp) const {
        return lamp.image.touched * std::max(m_scale * lamp.part - lamp.image.share, 0.);
    }

    double sum() const {
        std::vector<double> sums(m_chunks.size(), 0.);
        for_each_chunk([&](size_t i) {
            for (const SmallLamp &lamp : m_chunks[i].small)
                sums[i] += points(lamp);
        });
        double result = 0;
        for (double each : sums)
            result += each;
        return result;
    }

    template <typename F> void for_each_chunk(const F &f) const {
        for_chunks(m_chunks.size() * kChunk, [&](size_t i, size_t, size_t) { f(i); });
    }

    std::vector<Chunk> m_chunks;
    double m_scale = 1;
};

} // namespace manylights
