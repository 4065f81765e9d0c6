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

#include "lamp_points.h"
#include "manylights/base/host_storage.h"
#include "scene_lights.h"
#include <memory>

namespace manylights {

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

    /**
     * Null if no lamp is worth it.
     * @param size    pixels that are rendered
     * @param border  of them, those beyond each side of the film
     */
    static std::shared_ptr<LampsInView> choose(const Lights &lights,
                                               const CameraView<float> &camera,
                                               const mitsuba::Vector<uint32_t, 2> &size,
                                               uint32_t border) {
        std::shared_ptr<LampsInView> result(new LampsInView(lights));
        if (!result->choose(camera, size, border))
            return {};
        result->m_camera = camera.template opaque<FloatD>();
        return result;
    }

    /// Is there any lamp, and a camera with a view?
    static bool may_find(const Lights &lights, const Sensor *sensor) {
        return lights.can_be_hit() && lights.tree().light_count > 0 && has_view(sensor);
    }

    /// Pixels that are rendered beyond each side of the film
    static uint32_t border(const Sensor *sensor) {
        const auto *film = sensor->film();
        return film->sample_border() ? film->rfilter()->border_size() : 0;
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
    bool choose(const CameraView<float> &camera, const mitsuba::Vector<uint32_t, 2> &size,
                uint32_t border) {
        HostView rows(m_lights.tree().rows);
        uint32_t count = m_lights.tree().light_count;
        LampPoints lamps((const LightRow *) rows.data(), count, camera, size, border);

        HostStorage<mitsuba::DynamicBuffer<FloatD>> storage;
        float *rates = storage.allocate(count);
        std::fill_n(rates, count, 0.f);
        uint64_t end = 0;
        double sum = 0, mean_sum = 0;
        std::vector<uint32_t> chosen;
        std::vector<uint64_t> ends;
        lamps.for_each([&](uint32_t i, double number, float brightness) {
            // Fractions of 32 digits, so that both kinds of samples have the same numbers
            auto points = (uint64_t) (0x1p32 * number);
            rates[i]    = (float) points * 0x1p-32f;
            if (points == 0)
                return;
            chosen.push_back(i);
            ends.push_back(end += points);
            sum += brightness;
            mean_sum += (double) rates[i] * brightness;
        });
        m_rates = storage.close();
        if (chosen.empty())
            return false;
        m_points   = (uint32_t) ((end + 0xffffffffu) >> 32);
        m_count    = dr::opaque<UInt32D>((uint32_t) chosen.size());
        m_sum      = dr::opaque<FloatD>((float) sum);
        m_mean_sum = dr::opaque<FloatD>((float) mean_sum);
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
