#pragma once

/**
 * Lamps that are small on the film: emissive surfaces that camera rays rarely hit. Points on them
 * are sampled, too, and put on the film (render/lamp_splats.h).
 *
 * With one sample for each pixel, camera rays have the density D(w) for a unit of solid angle, seen
 * from the pinhole or a point of the lens, and lamp l gets r_l points of density p(w | l). Whatever
 * is seen of it, by a camera ray or at such a point, has the weight of the balance heuristic,
 *
 *     D / (D + r_l p(w | l)).
 *
 * All of this is the same for all samples of a pixel, so that they can be rendered in any passes.
 */

#include "camera_view.h"
#include "manylights/base/host_view.h"
#include "manylights/kinds/kinds.h"
#include "scene_lights.h"
#include <memory>

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
        : m_rows(rows), m_images(count) {
        for_chunks(count, [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                m_images[i] = LampImage::of(rows[i], camera, size, border);
        });
        double light = 0, pixels = (double) size.x() * size.y();
        for (uint32_t i = 0; i < count; ++i) {
            const LampImage &image = m_images[i];
            light += (double) rows[i].brightness * image.touched * image.share;
            if (image.touched > 0 && image.share < kMostShare)
                m_small.push_back(i);
        }
        m_others = kOthers * light / pixels;
        if (sum() <= kMostPoints * pixels)
            return;
        for (double step = .5; step > 1e-3; step *= .5)
            m_scale += sum() > kMostPoints * pixels ? -step : step;
    }

    /// Lamps that may get any
    const std::vector<uint32_t> &small() const { return m_small; }

    double points(uint32_t i) const {
        double share = m_images[i].share, light = m_rows[i].brightness * share,
               part = light > 0 ? light / (m_others + light) : 0;
        return m_images[i].touched * std::max(m_scale * part - share, 0.);
    }

private:
    /// Of all lamps, for each pixel and sample: a point takes less time than a camera ray
    static constexpr double kMostPoints = .1;
    /// The light B of a pixel, of the mean of all that lamps may show: many are hidden
    static constexpr double kOthers = .1;
    /// Above this share a lamp is large: camera rays do well alone
    static constexpr float kMostShare = .25f;

    double sum() const {
        double result = 0;
        for (uint32_t i : m_small)
            result += points(i);
        return result;
    }

    const LightRow *m_rows;
    HostVector<LampImage> m_images;
    std::vector<uint32_t> m_small;
    double m_others, m_scale = 1;
};

template <typename Float, typename Spectrum> class LampsInView {
public:
    MI_IMPORT_TYPES(Sensor)
    using Lights  = SceneLights<Float, Spectrum>;
    using FloatD  = typename Lights::FloatD;
    using UInt32D = typename Lights::UInt32D;
    using UInt64D = dr::uint64_array_t<UInt32D>;
    using MaskD   = typename Lights::MaskD;
    using Camera  = CameraView<FloatD>;

    /// A lamp, and the points that it gets for each sample of the pixels
    struct Lamp {
        UInt32D light;
        FloatD rate;
        MaskD active;
    };

    /// Null if no lamp is worth it
    static std::shared_ptr<LampsInView> find(const Lights &lights, const Sensor *sensor,
                                             const mitsuba::Vector<uint32_t, 2> &size) {
        if (!may_find(lights, sensor))
            return {};
        return find(lights, sensor, size, read_view(sensor));
    }
    static std::shared_ptr<LampsInView> find(const Lights &lights, const Sensor *sensor,
                                             const mitsuba::Vector<uint32_t, 2> &size,
                                             const CameraView<float> &camera) {
        std::shared_ptr<LampsInView> result(new LampsInView(lights));
        if (!result->choose(camera, sensor->film(), size))
            return {};
        result->m_camera = camera.template opaque<FloatD>();
        return result;
    }

    /// Is there any lamp, and a camera with a view?
    static bool may_find(const Lights &lights, const Sensor *sensor) {
        return lights.can_be_hit() && lights.tree().light_count > 0 && has_view(sensor);
    }

    MANYLIGHTS_TRAVERSE(m_camera, m_rates, m_chosen, m_ends, m_count, m_sum, m_mean_sum)

    const Camera &camera() const { return m_camera; }
    /// Numbers of points to choose for each sample of the pixels, see \ref at
    uint32_t points() const { return m_points; }
    /// A few more numbers of points, that have no lamp: the same for views that differ little
    void round_points() {
        uint32_t points = 1;
        while (points < m_points)
            points *= 2;
        m_points = points;
    }
    /// No pixel has more light after so many samples, in units of brightness
    FloatD most(uint32_t samples) const {
        constexpr float uneven = 34; // of a number of points, at most
        return m_mean_sum * (float) samples + m_sum * uneven;
    }

    /// The lamp of a point: `number` counts those of one sample, `start` is where they begin,
    /// a random fraction of 32 digits
    Lamp at(const UInt32D &number, const UInt32D &start) const {
        UInt64D place = dr::sl<32>(UInt64D(number)) | UInt64D(start);
        struct State {
            UInt32D low, high;
            DRJIT_STRUCT(State, low, high)
        };
        State state{ UInt32D(0), m_count };
        loop(
            state, [](const State &s) { return s.low < s.high; },
            [&](State &s) {
                UInt32D middle = (s.low + s.high) >> 1u;
                MaskD below    = dr::gather<UInt64D>(m_ends, middle) <= place;
                s.low          = dr::select(below, middle + 1u, s.low);
                s.high         = dr::select(below, s.high, middle);
            },
            "Lamps: choice");
        MaskD active  = state.low < m_count;
        UInt32D light = dr::gather<UInt32D>(m_chosen, state.low, active);
        return { light, dr::gather<FloatD>(m_rates, light, active), active };
    }

    /// Weight of a point that is sampled with the density `pdf`, seen along d
    FloatD weight(const mitsuba::Vector<FloatD, 3> &d, const FloatD &rate,
                  const FloatD &pdf) const {
        FloatD density = m_camera.density(d);
        return dr::select(rate > 0.f, density / dr::fmadd(rate, pdf, density), 1.f);
    }

    /// Weight of the emission of `light` at `si`, to which a camera ray has come
    MI_NOINLINE Float weight(const SurfaceInteraction3f &si, const Vector3f &direction,
                             const UInt32D &light, Mask active) const {
        MaskD found = plain(active) && light < kOnlyHit;
        if (dr::none_or<false>(found))
            return 1.f;
        FloatD rate = dr::gather<FloatD>(m_rates, light, found);
        found &= rate > 0.f;
        if (dr::none_or<false>(found))
            return 1.f;
        mitsuba::Point<FloatD, 3> p(plain(si.p));
        mitsuba::Vector<FloatD, 3> d(plain(direction)), n(plain(Vector3f(si.n)));
        auto from       = m_camera.lens_point(p, d);
        Row<FloatD> row = m_lights.tree().row(light, found);
        FloatD pdf      = by_kind<FloatD>(row, m_lights.table_kinds(), [&](auto kind) {
            return kind.pdf(row, from, p, n);
        });
        return Float(weight(d, rate, dr::select(found, pdf, 0.f)));
    }

    /// The same for any surface
    Float weight(const SurfaceInteraction3f &si, const Vector3f &direction,
                 Mask active) const {
        active &= si.is_valid();
        return weight(si, direction,
                      m_lights.find(si.shape, plain(si.prim_index), plain(active)),
                      active);
    }

private:
    explicit LampsInView(const Lights &lights) : m_lights(lights) {}

    /// Returns false if there are none
    bool choose(const CameraView<float> &camera,
                const mitsuba::Film<Float, Spectrum> *film,
                const mitsuba::Vector<uint32_t, 2> &size) {
        HostView rows(m_lights.tree().rows);
        const LightRow *row = (const LightRow *) rows.data();
        uint32_t count      = m_lights.tree().light_count;
        LampPoints lamps(row, count, camera, size,
                         film->sample_border() ? film->rfilter()->border_size() : 0);

        HostVector<float> rates(count);
        std::fill(rates.begin(), rates.end(), 0.f);
        uint64_t end = 0;
        double sum = 0, mean_sum = 0;
        std::vector<uint32_t> chosen;
        std::vector<uint64_t> ends;
        for (uint32_t i : lamps.small()) {
            // Fractions of 32 digits, so that both kinds of samples have the same numbers
            auto points = (uint64_t) (0x1p32 * lamps.points(i));
            rates[i]    = (float) points * 0x1p-32f;
            if (points == 0)
                continue;
            chosen.push_back(i);
            ends.push_back(end += points);
            sum += row[i].brightness;
            mean_sum += (double) rates[i] * row[i].brightness;
        }
        if (chosen.empty())
            return false;
        m_points   = (uint32_t) ((end + 0xffffffffu) >> 32);
        m_count    = dr::opaque<UInt32D>((uint32_t) chosen.size());
        m_sum      = dr::opaque<FloatD>((float) sum);
        m_mean_sum = dr::opaque<FloatD>((float) mean_sum);
        m_rates    = dr::load<mitsuba::DynamicBuffer<FloatD>>(rates.data(), count);
        m_chosen =
            dr::load<mitsuba::DynamicBuffer<UInt32D>>(chosen.data(), chosen.size());
        m_ends = dr::load<mitsuba::DynamicBuffer<UInt64D>>(ends.data(), ends.size());
        return true;
    }

    const Lights &m_lights;
    Camera m_camera;
    /// Of each light: points for each sample of the pixels
    mitsuba::DynamicBuffer<FloatD> m_rates;
    /// Lights that have any, and where each one's points end, as fractions of 32 digits
    mitsuba::DynamicBuffer<UInt32D> m_chosen;
    mitsuba::DynamicBuffer<UInt64D> m_ends;
    UInt32D m_count   = 0;
    uint32_t m_points = 0;
    /// Brightness of all of them, and of the points of one sample
    FloatD m_sum = 0.f, m_mean_sum = 0.f;
};

/// A value and its weight; its derivative is that without the other samples
template <typename Float, typename Value>
Value weigh_lamp(const Value &value, const Float &weight) {
    Value result = value * weight;
    if constexpr (dr::is_diff_v<Float>)
        if (dr::grad_enabled(value))
            result += (value - dr::detach(value)) * (1.f - weight);
    return result;
}

} // namespace manylights
