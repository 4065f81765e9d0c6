#pragma once

/**
 * What the lights of a scene emit: radiance of a row of the table, of a surface whose
 * radiance varies, and of whatever a ray has hit.
 */

#include "manylights/emission/surface_hit.h"
#include "manylights/kinds/kinds.h"
#include "scene_lights.h"

namespace manylights {

template <typename Float, typename Spectrum> class SceneEmission {
public:
    MI_IMPORT_TYPES(Scene, Emitter, EmitterPtr, Shape)
    using Lights  = SceneLights<Float, Spectrum>;
    using FloatD  = typename Lights::FloatD;
    using UInt32D = typename Lights::UInt32D;
    using MaskD   = typename Lights::MaskD;

    SceneEmission(const Scene *scene, const Lights &lights)
        : m_scene(scene), m_lights(lights) {}

    /// The light that a ray has hit: its index in the table, kOnlyHit, or kNone
    UInt32D light_at(const SurfaceInteraction3f &si, Mask active) const {
        if (!m_lights.can_be_hit())
            return kNone;
        return m_lights.find(si.shape, plain(si.prim_index),
                             plain(active && si.is_valid()));
    }

    /// Can there be emission where a ray found this light, or nothing at all?
    Mask may_emit(const UInt32D &light, const Mask &hit) const {
        return light != kNone || (m_scene->environment() && !hit);
    }

    /**
     * The light that a ray finds and whether there can be emission. `si` is what it finds, as
     * far as emission and its density depend on that; scalar variants fill it only if there
     * can be any. Where the table knows all emission, no shape is called: normals come from
     * the rows, and there are none on surfaces that do not emit.
     */
    std::pair<UInt32D, Mask> find_light(const Ray3f &ray, SurfaceInteraction3f &si,
                                        Mask active) const {
        if (m_lights.needs_emitter_eval()) {
            si            = m_scene->ray_intersect(ray, active);
            UInt32D light = light_at(si, active);
            return { light, may_emit(light, si.is_valid()) };
        }
        auto pi = m_scene->ray_intersect_preliminary(ray, /* coherent = */ false, active);
        Mask valid    = active && pi.is_valid();
        UInt32D light = kNone;
        if (m_lights.can_be_hit())
            light = m_lights.find(pi.shape, plain(pi.prim_index), plain(valid));
        Mask emits = may_emit(light, valid);
        if (dr::none_or<false>(emits))
            return { light, emits };
        si             = dr::zeros<SurfaceInteraction3f>();
        si.t           = dr::select(valid, pi.t, dr::Infinity<Float>);
        si.p           = dr::select(valid, ray(pi.t), ray.o);
        si.time        = ray.time;
        si.wavelengths = ray.wavelengths;
        si.shape       = dr::select(valid, pi.shape, nullptr);
        si.prim_index  = pi.prim_index;
        si.wi          = -ray.d;
        MaskD found    = light < kOnlyHit;
        if (!dr::any_or<true>(found))
            return { light, emits };
        Row<FloatD> row = m_lights.tree().row(light, found);
        using VectorD   = mitsuba::Vector<FloatD, 3>;
        si.n = by_kind<VectorD>(row, m_lights.table_kinds(),
                                [&](auto kind) { return kind.normal(row, plain(si.p)); });
        si.wi = dr::select(valid, Vector3f(0.f, 0.f, dr::dot(si.n, si.wi)), si.wi);
        return { light, emits };
    }

    /// Radiance emitted from a surface, which is `light`, or from the environment, against
    /// the ray that found it
    MI_NOINLINE Spectrum emitted(const SurfaceInteraction3f &si, const UInt32D &light,
                                 Mask active) const {
        Spectrum result(0.f);
        if (m_lights.can_be_hit()) {
            Mask in_table = light < kOnlyHit, by_plugin = light == kOnlyHit;
            if (dr::any_or<true>(in_table)) {
                Row<FloatD> row = m_lights.tree().row(light, plain(in_table));
                Mask tabulated  = in_table && row.tabulated();
                Mask front      = Frame3f::cos_theta(si.wi) > 0.f;
                by_plugin |= in_table && !tabulated;
                if (dr::any_or<true>(tabulated))
                    result = mitsuba::depolarizer<Spectrum>(color(row, si.wavelengths) &
                                                            (tabulated && front));
            }
            if (m_lights.needs_emitter_eval())
                add_masked(result, by_plugin,
                           [&](Mask m) { return si.shape->emitter()->eval(si, m); });
        }
        if (const Emitter *environment = m_scene->environment())
            add_masked(result, active && !si.is_valid(),
                       [&](Mask m) { return environment->eval(si, m); });
        return result;
    }

    EmitterPtr emitter_of(const Row<FloatD> &row) const {
        using UInt32 = dr::uint32_array_t<Float>;
        return dr::gather<EmitterPtr>(m_scene->emitters_dr(), UInt32(row.emitter()),
                                      Mask(true));
    }

    /// Radiance or intensity of a tabulated row
    static UnpolarizedSpectrum color(const Row<FloatD> &row,
                                     const Wavelength &wavelengths) {
        if constexpr (mitsuba::is_spectral_v<Spectrum>) {
            dr::Array<Float, 3> coefficients(row[kColor], row[kColor + 1],
                                             row[kColor + 2]);
            return Float(row[kScale]) *
                   mitsuba::cie_d65<UnpolarizedSpectrum>(wavelengths) *
                   mitsuba::srgb_model_eval<UnpolarizedSpectrum>(coefficients,
                                                                 wavelengths);
        } else {
            UnpolarizedSpectrum result;
            for (size_t i = 0; i < result.size(); ++i)
                result.entry(i) = row[kColor + i];
            return result;
        }
    }

    /// Radiance at a point of a light that is not tabulated (any kind but `Other`), from its
    /// emitter
    MI_NOINLINE Spectrum emission_by_emitter(const Interaction3f &from,
                                             const Row<FloatD> &row,
                                             const LightPoint<FloatD> &point,
                                             const Vector3f &d, Mask active) const {
        EmitterPtr emitter = emitter_of(row);
        MaskD swapped      = row[kColor + 1] > 0.f;
        Point2f uv(dr::select(swapped, point.uv.y(), point.uv.x()),
                   dr::select(swapped, point.uv.x(), point.uv.y()));
        // From close by: a small shape far away is still hit where the point is
        Float t = dr::norm(Point3f(point.p) - from.p) * (1.f / 1024.f);
        auto pi =
            surface_hit<Float, Shape>(emitter->shape(), row.bits(kColor), uv, t, active);
        Ray3f ray(Point3f(point.p) - d * t, d, from.time, from.wavelengths);
        SurfaceInteraction3f si =
            pi.compute_surface_interaction(ray, +mitsuba::RayFlags::All, active);
        return emitter->eval(si, active);
    }

    /// Radiance or intensity at a point of a light (any kind but `Other`), seen along d
    Spectrum of_point(const Interaction3f &from, const Row<FloatD> &row,
                      const LightPoint<FloatD> &point, const Vector3f &d,
                      Mask active) const {
        Spectrum result = tabulated(row, from.wavelengths);
        if (m_lights.needs_emitter_eval())
            add_masked(result, active && !row.tabulated(), [&](Mask m) {
                return emission_by_emitter(from, row, point, d, m);
            });
        return result;
    }

    /// The same without asking emitters: 0 where that would be necessary
    static Spectrum tabulated(const Row<FloatD> &row, const Wavelength &wavelengths) {
        return mitsuba::depolarizer<Spectrum>(color(row, wavelengths) &
                                              Mask(row.tabulated()));
    }

    /// Add f(mask) where the mask is set; scalar variants do not call f otherwise
    template <typename F>
    static void add_masked(Spectrum &result, Mask mask, const F &f) {
        if (dr::any_or<true>(mask))
            dr::masked(result, mask) = result + f(mask);
    }

private:
    const Scene *m_scene;
    const Lights &m_lights;
};

} // namespace manylights
