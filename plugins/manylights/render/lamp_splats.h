#pragma once

/**
 * Points on lamps that are small on the film (scene/lamps_in_view.h), seen from the camera and put
 * on the film. Each sample of the pixels has its points, a function of its number and the seed
 * alone: passes may have any of them.
 */

#include "film_color.h"
#include "fixed_point_sums.h"
#include "manylights/base/divide.h"
#include "manylights/base/random.h"
#include "manylights/sampler/sobol.h"
#include "manylights/scene/lamp_views.h"
#include "manylights/scene/media.h"
#include "manylights/scene/scene_emission.h"
#include "passes.h"

namespace manylights {

template <typename Float, typename Spectrum> class LampSplats {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Film, Medium, MediumPtr)
    using Lights   = SceneLights<Float, Spectrum>;
    using Lamps    = LampsInView<Float, Spectrum>;
    using Emission = SceneEmission<Float, Spectrum>;
    using Media    = manylights::Media<Float, Spectrum>;
    using Sums     = FixedPointSums<Float, Spectrum>;
    using Pass     = manylights::Pass<Float, Spectrum>;
    using FloatD   = typename Lights::FloatD;
    using UInt32D  = typename Lights::UInt32D;
    using MaskD    = typename Lights::MaskD;
    using PointD   = mitsuba::Point<FloatD, 3>;
    using VectorD  = mitsuba::Vector<FloatD, 3>;

    /**
     * @param media     that camera rays pass; none if they end at the first surface
     * @param channels  what the film has beside colours
     */
    LampSplats(const Scene *scene, const Lights &lights, const Lamps &lamps,
               const MediaKinds &media, Sensor *sensor, const FilmChannels &channels)
        : m_scene(scene), m_lights(lights), m_lamps(lamps), m_emission(scene, lights),
          m_media(scene, media), m_sensor(sensor), m_film(sensor->film()),
          m_channels(channels) {}

    /// Those of a pass. Its samples are complete with the pixels that do not train.
    void render(const Pass &pass) const {
        if (pass.plan.role == Role::Train)
            return;
        UInt32D key = mitsuba::sample_tea_32(UInt32D(plain(pass.plan_seed)),
                                             UInt32D(pass.plan.scramble), 8)
                          .first;
        dr::make_opaque(key);
        Sums sums(m_film, Float(m_lamps.most(pass.plan.count)), m_channels,
                  m_lights.groups().count());
        uint32_t points = m_lamps.points(), most = std::max(kMostLanes / points, 1u);
        for (uint32_t done = 0; done < pass.plan.count; done += most) {
            uint32_t count = std::min(most, pass.plan.count - done) * points;
            if constexpr (dr::is_jit_v<Float>) {
                auto [sample, point] = divide(dr::arange<UInt32D>(count), points);
                add(sums, key, sample + dr::opaque<UInt32D>(pass.plan.first + done),
                    point);
                dr::eval();
            } else {
                dr::parallel_for(dr::blocked_range<uint32_t>(0, count, kGrain),
                                 [&](const auto &range) {
                                     for (uint32_t i : range)
                                         add(sums, key,
                                             pass.plan.first + done + i / points,
                                             i % points);
                                 });
            }
        }
        sums.put();
    }

private:
    static constexpr uint32_t kMostLanes = 1u << 28, kGrain = 1024;

    /// Random numbers of a point
    class Numbers {
    public:
        Numbers(const UInt32D &key, const UInt32D &sample, const UInt32D &point)
            : m_key(key), m_sample(sample), m_point(mix_bits<UInt32D>(point + key)) {}

        /// Where the choice of lamps begins, the same for all points of a sample
        UInt32D start() const { return numbers(0).number(); }

        /// Even for the samples of a pixel; points have different ones
        mitsuba::Point<FloatD, 2> pair(uint32_t dimension) const {
            auto [a, b] = numbers(dimension).pair();
            UInt32D c   = mix_bits<UInt32D>(m_point + dimension * 0x9e3779b9u);
            return { fraction(a ^ c), fraction(b ^ mix_bits<UInt32D>(c ^ 0x5bd1e995u)) };
        }

        typename Media::Rng rng() const { return seeded_rng(m_sample, m_point, 3); }

    private:
        SobolSample<UInt32D> numbers(uint32_t dimension) const {
            return { m_key, m_sample, UInt32D(dimension) };
        }
        static FloatD fraction(const UInt32D &digits) {
            return FloatD(digits >> 8u) * 0x1p-24f;
        }

        UInt32D m_key, m_sample, m_point;
    };

    /// A point of a lamp, as a camera sees it
    struct Seen {
        Row<FloatD> row;
        LightPoint<FloatD> point;
        UInt32D light;
        Ray3f ray;
        Float distance;
    };

    void add(Sums &sums, const UInt32D &key, const UInt32D &sample,
             const UInt32D &number) const {
        Numbers u(key, sample, number);
        auto lamp = m_lamps.at(number, u.start());
        if (dr::none_or<false>(lamp.active))
            return;
        Seen seen;
        seen.light         = dr::select(lamp.active, lamp.light, 0u);
        seen.row           = m_lights.tree().row(seen.light, lamp.active);
        const auto &camera = m_lamps.camera();
        PointD from  = camera.has_lens() ? camera.lens_point(u.pair(4)) : camera.position;
        auto on_lamp = u.pair(2);
        seen.point =
            by_kind<LightPoint<FloatD>>(seen.row, m_lights.table_kinds(), [&](auto kind) {
                return kind.sample(seen.row, from, on_lamp);
            });
        VectorD d    = dr::normalize(seen.point.p - from);
        FloatD depth = camera.depth(seen.point.p);
        auto place   = camera.on_film(seen.point.p, from);
        MaskD active = lamp.active && seen.point.pdf > 0.f && depth >= camera.near_clip &&
                       depth <= camera.far_clip && is_rendered(place);
        if (dr::none_or<false>(active))
            return;

        FloatD cosine = dr::dot(d, camera.axes[2]);
        seen.ray = Ray3f(Point3f(from + d * (camera.near_clip / cosine)), Vector3f(d));
        seen.distance     = Float((depth - camera.near_clip) / cosine);
        seen.ray.maxt     = Float((camera.far_clip - camera.near_clip) / cosine);
        Spectrum emission = draw_spectrum(seen.ray, u);
        emission *= Float(m_lamps.weight(d, lamp.rate, seen.point.pdf));
        emission *= emitted(seen, Mask(active));
        put(sums, seen, place, emission, u, active);
    }

    /// Put what arrives of the emission of a point on the film
    void put(Sums &sums, const Seen &seen, const mitsuba::Point<FloatD, 2> &place,
             const Spectrum &emission, const Numbers &u, MaskD active) const {
        FloatD most = seen.row[kBrightness] * Sums::kHeadroom;
        auto color  = [&](const Spectrum &value) {
            Color3f result = film_color<Float, Spectrum>(
                mitsuba::unpolarized_spectrum(value), seen.ray.wavelengths, Mask(active));
            active &= plain(dr::all(dr::isfinite(result)));
            return dr::clip(result, -Float(most), Float(most));
        };
        typename Sums::Value value;
        bool media     = m_media.kinds().any;
        value.arrives  = color(transmittance(seen, u, Mask(active)) * emission);
        value.emission = value.arrives;
        if (media && !m_channels.emissions.empty())
            value.emission = color(emission & in_sight(seen, Mask(active)));
        value.group = 0;
        if (m_lights.groups().count() > 0)
            value.group = m_lights.groups().of_light(m_lights.tree(), seen.light, active);
        sums.add(Point2f(place), value, Mask(active));
    }

    /// Does the film have samples there?
    MaskD is_rendered(const mitsuba::Point<FloatD, 2> &place) const {
        float border =
            m_film->sample_border() ? (float) m_film->rfilter()->border_size() : 0.f;
        auto size = m_film->crop_size();
        return place.x() >= -border && place.x() < (float) size.x() + border &&
               place.y() >= -border && place.y() < (float) size.y() + border;
    }

    /// Time and wavelengths of a ray, as samples of cameras have them. Returns their weight.
    Spectrum draw_spectrum(Ray3f &ray, const Numbers &u) const {
        bool moves = m_sensor->shutter_open_time() > 0.f;
        ray.time   = m_sensor->shutter_open();
        Spectrum weight(1.f);
        if (!moves && !mitsuba::is_spectral_v<Spectrum>)
            return weight;
        auto pair = u.pair(6);
        if (moves)
            ray.time += Float(pair.x()) * m_sensor->shutter_open_time();
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            std::tie(ray.wavelengths, weight) = m_sensor->sample_wavelengths(
                dr::zeros<SurfaceInteraction3f>(), Float(pair.y()), true);
        return weight;
    }

    /// How much of it arrives
    Spectrum transmittance(const Seen &seen, const Numbers &u, Mask active) const {
        if (!m_media.kinds().any)
            return dr::select(in_sight(seen, active), Spectrum(1.f), Spectrum(0.f));
        Interaction3f from(0.f, seen.ray.time, seen.ray.wavelengths, seen.ray.o);
        auto rng         = u.rng();
        MediumPtr medium = m_sensor->medium();
        return m_media.transmittance(
            from, Point3f(seen.point.p),
            Mask(may_end_close(seen.row, m_lights.table_kinds())), medium, rng, active);
    }

    /// Would a camera ray find it? Nothing before the point will do
    Mask in_sight(const Seen &seen, Mask active) const {
        auto pi   = m_scene->ray_intersect_preliminary(seen.ray, false, active);
        Mask past = !pi.is_valid() || pi.t >= seen.distance;
        past |= Mask(m_lights.find(pi.shape, plain(pi.prim_index),
                                   plain(active && pi.is_valid())) == seen.light);
        past &= !Mask(hides_itself(seen.row, m_lights.table_kinds(), seen.point.p,
                                   PointD(plain(seen.ray.o))));
        return active && past;
    }

    /// The emission of a point towards the camera
    Spectrum emitted(const Seen &seen, Mask active) const {
        Interaction3f from(0.f, seen.ray.time, seen.ray.wavelengths, seen.ray.o);
        return m_emission.of_point(from, seen.row, seen.point, seen.ray.d, active) &
               active;
    }

    const Scene *m_scene;
    const Lights &m_lights;
    const Lamps &m_lamps;
    Emission m_emission;
    Media m_media;
    Sensor *m_sensor;
    Film *m_film;
    const FilmChannels &m_channels;
};

/// The lamps that a rendering samples on the film: known to its camera rays for a while
template <typename Float, typename Spectrum> class LampPasses {
public:
    MI_IMPORT_TYPES(Scene, Sensor)
    using Splats = LampSplats<Float, Spectrum>;
    using Lamps  = typename Splats::Lamps;
    using Views  = LampViews<Float, Spectrum>;

    /**
     * @param known      where camera rays find them
     * @param views      those of functions that are recorded
     * @param rendering  has those of other functions
     * @param shown      can there be any?
     * The others are those of \ref LampSplats.
     */
    template <typename Rendering>
    LampPasses(std::shared_ptr<const Lamps> &known, const Views &views,
               const Rendering &rendering, const Scene *scene, Sensor *sensor, bool shown,
               const MediaKinds &media, const FilmChannels &channels)
        : m_known(known) {
        auto size = film_size(sensor->film());
        if (shown && is_recorded<Float>())
            m_known = views.find(scene, sensor, rendering.lights(), size);
        else if (shown)
            m_known = rendering.lamps(sensor, size);
        if (m_known)
            m_splats = std::make_unique<Splats>(scene, rendering.lights(), *m_known,
                                                media, sensor, channels);
    }
    ~LampPasses() { m_known.reset(); }
    LampPasses(const LampPasses &) = delete;

    void render(const typename Splats::Pass &pass) const {
        if (m_splats)
            m_splats->render(pass);
    }

private:
    std::shared_ptr<const Lamps> &m_known;
    std::unique_ptr<Splats> m_splats;
};

} // namespace manylights
